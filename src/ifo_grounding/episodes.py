"""The one player of episodes: evaluation, selection, audits and recordings all use it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, RandomPolicy

from ifo_grounding import keys
from ifo_grounding.attributes import untransformed
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.modules import exploring
from ifo_grounding.progress import progress_bar

MODES = {"greedy": ExplorationType.DETERMINISTIC, "sampled": ExplorationType.RANDOM}
"""How actions are chosen: the likeliest, or drawn from the policy's distribution."""

Policy = Callable[[TensorDictBase], TensorDictBase]
"""Anything that writes an action into a tensordict, a TensorDictModule mostly."""
OnStep = Callable[[Tensor, TensorDictBase], None]
"""Called after each step with the rows that took it, int64 [R], and their transitions, [R]."""


class Outcomes(NamedTuple):
    """How episodes ended."""

    success: Tensor
    """Whether the step that ended the episode paid a true reward above 0, bool [N]."""
    lengths: Tensor
    """Actions taken, the stop included, int64 [N]."""
    stopped: Tensor
    """Whether the episode terminated, by the policy's stop or by the world, bool [N]."""


def play(
    policy: Policy,
    env: EnvBase,
    start: TensorDictBase,
    *,
    mode: str = "greedy",
    max_steps: int,
    on_step: OnStep | None = None,
) -> Outcomes:
    """Play every row's episode to its end, once; return the outcomes of all N rows.

    The policy is asked for the rows still running only. What rows do after their episode is
    ignored; an episode that has not ended after ``max_steps`` counts as a failure.

    Args:
        policy: writes an action; put it into eval mode yourself
            (:func:`~ifo_grounding.modules.evaluating`). Entries that it writes under ``next``, such
            as a recurrent state, are handed to it at the next step.
        env: a batched environment, just reset.
        start: what its reset returned.
        mode: ``greedy`` or ``sampled``.

    Raises:
        UserError: where the policy writes no action, or none of the environment's.

    >>> from ifo_grounding.envs import PickAndPlaceEnv
    >>> env = PickAndPlaceEnv("move", num_envs=3, seed=0)
    >>> stop = lambda td: td.set("action", torch.full(td.shape, 5))
    >>> play(stop, env, env.reset(), max_steps=40).lengths.tolist()
    [1, 1, 1]
    """
    check_choice("mode", mode, MODES)
    # An environment may declare that rows are stepped after their end; others are reset.
    steps_on = getattr(type(untransformed(env)), "steps_on", False)
    rows = env.batch_size.numel()
    on = {"device": start.device or env.device}
    success = torch.zeros(rows, dtype=torch.bool, **on)
    lengths = torch.zeros(rows, dtype=torch.int64, **on)
    stopped = torch.zeros(rows, dtype=torch.bool, **on)
    active = torch.arange(rows, **on)
    true_reward = keys.REWARD if keys.REWARD in env.reward_keys else env.reward_keys[0]
    state = start
    with exploring(MODES[mode]):
        for _ in progress_bar(iter(range(max_steps)), "play", leave=False):
            state[env.action_key] = _actions(policy, env, state, active)
            stepped = env.step(state)
            transition = stepped.reshape(rows)[active]
            after = transition[keys.NEXT]
            ended = after["done"].reshape(-1)
            lengths[active] += 1
            success[active] = ended & (after[true_reward].reshape(-1) > 0)
            stopped[active] = ended & after.get("terminated", after["done"]).reshape(-1)
            if on_step is not None:
                on_step(active, transition)
            active = active[~ended]
            if not len(active):
                break
            state = env.step_mdp(stepped)
            if not steps_on:
                state = env.maybe_reset(state)
    return Outcomes(success, lengths, stopped)


def _actions(policy: Policy, env: EnvBase, state: TensorDictBase, active: Tensor) -> Tensor:
    """Return actions of all rows; the policy is asked for active ones, others get the first action.

    What a policy with a memory wrote for its next step is put into ``state``.
    """
    if isinstance(policy, RandomPolicy):  # draws for the whole batch of its spec
        return policy(state)[env.action_key]
    every = env.action_spec.zero()
    rows = env.batch_size.numel()
    action = every.reshape(rows, *every.shape[len(env.batch_size) :]).clone()
    asked = policy(state.reshape(rows)[active])
    chosen = asked.get(env.action_key, None)
    _check(chosen, env, torch.Size([len(active), *action.shape[1:]]))
    for key in env.observation_spec.keys(True, True):
        following = unravel_key((keys.NEXT, key))
        if (kept := asked.get(following, None)) is not None:
            memory = env.observation_spec[key].zero().reshape(rows, *kept.shape[1:])
            memory[active] = kept.to(memory)
            state[following] = memory.reshape(*env.batch_size, *kept.shape[1:])
    action[active] = chosen.to(action)
    return action.reshape(every.shape)


def _check(chosen: Tensor | None, env: EnvBase, shape: torch.Size) -> None:
    if chosen is None:
        raise UserError(
            f"the policy writes no action: a policy writes its actions under {env.action_key!r}, "
            "such as one of make_policy, or a ProbabilisticActor around a module of logits"
        )
    if chosen.shape != shape:
        raise UserError(
            f"the policy's actions of {shape[0]} rows have the shape {list(chosen.shape)}, the "
            f"environment takes {list(shape)}: make it with categorical_action_encoding=True if "
            "it is one-hot, or a policy for it"
        )
    if chosen.is_floating_point() and not env.action_spec.dtype.is_floating_point:
        raise UserError(
            f"the policy's actions are {chosen.dtype}, the environment's are numbers of actions: "
            "make the policy write which action it takes, not values or logits"
        )
