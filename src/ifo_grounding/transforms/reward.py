"""The paper's reward: the probability that an action is right, from a learned model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded

from ifo_grounding.errors import UserError
from ifo_grounding.keys import ACTION, ACTION_SCORE, LEARNED_REWARD, NEXT
from ifo_grounding.modules import device_of, evaluating, output_key
from ifo_grounding.transforms.base import EpisodeTransform, flat_logit, parts_of, rows_of

ROWS_AT_ONCE = 4096
"""Rows that a model scores together, to bound memory."""


class RewardTransform(EpisodeTransform):
    """A transform that writes what :meth:`pay` says a step is worth, by a learned model.

    Args:
        model: writes a logit of the name ``logit``.
        also: names of what is read besides the model's ``in_keys``, and after it.
    """

    arrival: float | None = None
    """Probability at which the transform ends an episode; None where it ends none."""

    def __init__(
        self,
        model: TensorDictModuleBase,
        logit: str,
        in_keys: Sequence[NestedKey] | None,
        out_keys: Sequence[NestedKey] | None,
        also: Sequence[NestedKey] = (),
    ) -> None:
        self.logit_key = output_key(model, logit)
        names = [unravel_key(key) for key in (*model.in_keys, *also)]
        read = [unravel_key(key) for key in in_keys or names]
        if len(read) != len(names):
            raise UserError(f"in_keys name an entry for each of {names}, got {read}")
        written = [unravel_key(key) for key in out_keys or [LEARNED_REWARD]]
        if len(written) != 1:
            raise UserError(f"out_keys name the reward, one key, got {written}")
        super().__init__(in_keys=read, out_keys=written)
        self.model = model
        self._names = names

    def pay(self, before: TensorDictBase, after: TensorDictBase) -> Tensor:
        """Return the reward, float32 [*B, 1], of steps [*B] and what they led to [*B]."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the reward of collected steps [*B] below ``next``."""
        after = tensordict.get(NEXT, tensordict.empty())
        after.set(self.out_keys[0], self.pay(tensordict, after))
        return tensordict.set(NEXT, after)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._check_place()
        return next_tensordict.set(self.out_keys[0], self.pay(tensordict, next_tensordict))

    def _check_place(self) -> None:
        """Refuse a later transform that changes what the model reads.

        A step is given what later transforms made of the last observation.
        """
        parts = parts_of(self.container.transform)
        later = parts[parts.index(self) + 1 :]
        written = {unravel_key(key) for part in later for key in part.out_keys or []}
        if changed := written & set(self.in_keys):
            changed &= set(self.parent.full_observation_spec.keys(True, True))
        if changed:
            raise UserError(
                f"a transform after {type(self).__name__} changes {sorted(map(str, changed))}, "
                "which its model reads: put it before, or let it write to other out_keys"
            )

    def _score(self, entries: Sequence[Tensor]) -> Tensor:
        """Logits [R] for what the model reads, on the device of these entries."""
        home, rows = entries[0].device, len(entries[0])
        if not rows:
            return torch.zeros(0, dtype=torch.float32, device=home)
        device, key = device_of(self.model) or home, self.logit_key
        batch = TensorDict(dict(zip(self.model.in_keys, entries, strict=True)), [rows])
        with evaluating(self.model):
            parts = [
                flat_logit(self.model(part.to(device)).get(key), len(part), key)
                for part in batch.split(ROWS_AT_ONCE)
            ]
        return torch.cat(parts).to(home)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Declare the learned reward beside the true one."""
        if (key := self.out_keys[0]) in reward_spec.keys(True, True):
            raise UserError(
                f"the environment pays {key!r} already, which stays where it is: give other "
                "out_keys, and tell losses with set_keys(reward=...)"
            )
        reward_spec[key] = Unbounded(
            shape=(*reward_spec.shape, 1), dtype=torch.float32, device=reward_spec.device
        )
        return reward_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Declare what a step reads (batched environments send it to workers)."""
        observations = self.parent.full_observation_spec
        names = set(observations.keys(True, True))
        for key in set(self.in_keys) & names - set(state_spec.keys(True, True)):
            state_spec[key] = observations[key].clone()
        return state_spec


class LearnedReward(RewardTransform):
    """Pays every step the probability that its action is right (paper, "Reward Module").

    The reward is ``rwd(s, t, a)``, the sigmoid of the reward model's logit for the state, the
    instruction and the action, written under ``("next", "learned_reward")``. The true reward stays
    where it is, and the model in its mode (train or eval). Called on a tensordict, or appended to a
    replay buffer, the transform relabels steps that were collected before.

    Args:
        reward_model: TensorDictModule from (pixels, instruction, action) to a logit.
        in_keys: entries of a step that the model reads, in the order of the model's own
            ``in_keys``; by default those themselves. One-hot actions are turned into numbers.
        out_keys: key of the reward, below ``next``; by default ``learned_reward``.

    Raises:
        UserError: on a model or keys of another form; where a later transform changes what the
            model reads, or the environment already pays a reward of that name.

    >>> from tensordict.nn import TensorDictModule
    >>> model = TensorDictModule(lambda action: (action * 0.0).unsqueeze(-1), ["action"],
    ...                          ["action_score"])
    >>> batch = TensorDict({"action": torch.tensor([0, 3])}, [2])
    >>> LearnedReward(model)(batch)["next", "learned_reward"].tolist()
    [[0.5], [0.5]]
    """

    def __init__(
        self,
        reward_model: TensorDictModuleBase,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(reward_model, ACTION_SCORE, in_keys, out_keys)

    def pay(self, before: TensorDictBase, after: TensorDictBase) -> Tensor:
        """Return the probabilities of actions, float32 [*B, 1]."""
        entries = [rows_of(before, key) for key in self.in_keys]
        for place, name in enumerate(self._names):
            if last_part(name) == ACTION:
                entries[place] = numbers(entries[place])
        return self._score(entries).sigmoid().view(*before.batch_size, 1)


def last_part(key: NestedKey) -> str:
    """Return the last name of a nested key."""
    return key if isinstance(key, str) else key[-1]


def numbers(action: Tensor) -> Tensor:
    """Return the numbers of actions, which may be one-hot.

    >>> numbers(torch.tensor([[0, 0, 1], [1, 0, 0]])).tolist()
    [2, 0]
    """
    if action.ndim < 2 or action.shape[-1] == 1:
        return action
    return (action.byte() if action.dtype == torch.bool else action).argmax(-1)
