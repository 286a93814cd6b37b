"""Playing some rows of a batch of worlds to their ends, while others have ended already."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import RandomPolicy

from ifo_grounding import keys
from ifo_grounding.attributes import attribute
from ifo_grounding.errors import UserError

Policy = Callable[[TensorDictBase], TensorDictBase]
"""Anything that writes an action into a tensordict, a TensorDictModule mostly."""
STEPS_ON = "steps_on"
"""What an environment is true of that may be stepped after an end as if there had been none."""


def actions_of(policy: Policy, env: EnvBase, state: TensorDictBase, active: Tensor) -> Tensor:
    """Return actions for all rows of an environment, of which only some are asked of the policy.

    What a policy with a memory wrote for its next step is put into ``state``.

    Args:
        policy: writes an action; a random policy is asked for all rows.
        env: a batched environment.
        state: what it shows.
        active: numbers of the rows that are asked for, int64 [R]; others get the first action.

    Raises:
        UserError: where the policy's actions are none of the environment's.
    """
    if isinstance(policy, RandomPolicy):  # draws for the whole batch of its spec
        return policy(state)[env.action_key]
    every = env.action_spec.zero()
    shape = (env.batch_size.numel(), *every.shape[len(env.batch_size) :])
    action = every.reshape(shape).clone()
    asked = policy(state.reshape(shape[0])[active])
    _remember(asked, env, state, active)
    chosen = asked[env.action_key]
    if chosen.shape != (wanted := torch.Size([len(active), *shape[1:]])):
        raise UserError(
            f"the policy's actions of {len(active)} rows have the shape {list(chosen.shape)}, the "
            f"environment takes {list(wanted)}: make it with categorical_action_encoding=True if "
            "it is one-hot, or a policy for it"
        )
    if chosen.is_floating_point() and not action.is_floating_point():
        raise UserError(
            f"the policy's actions are {chosen.dtype}, the environment's are numbers of actions: "
            "make the policy write which action it takes, not values or logits"
        )
    action[active] = chosen.to(action)
    return action.reshape(every.shape)


def _remember(asked: TensorDictBase, env: EnvBase, state: TensorDictBase, active: Tensor) -> None:
    """Pass on what a policy with a memory wrote for the next step, such as a recurrent state."""
    for key in env.observation_spec.keys(True, True):
        following = unravel_key((keys.NEXT, key))
        kept = asked.get(following, None)
        if kept is None:
            continue
        every = env.observation_spec[key].zero().reshape(-1, *kept.shape[1:])
        every[active] = kept.to(every)
        state[following] = every.reshape(*env.batch_size, *kept.shape[1:])


def following(env: EnvBase, stepped: TensorDictBase) -> TensorDictBase:
    """Return what an environment shows after a step; rows whose episode has ended begin anew.

    Those that may be stepped on are, which spares new scenes for rows that nobody looks at.
    """
    state = env.step_mdp(stepped)
    return state if attribute(env, STEPS_ON) else env.maybe_reset(state)
