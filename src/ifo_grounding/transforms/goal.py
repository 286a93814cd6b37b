"""The reward of a goal: a classifier's probability that an instruction is fulfilled."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite

from ifo_grounding.attributes import attribute
from ifo_grounding.errors import UserError, whole
from ifo_grounding.keys import ACTION, GOAL_SCORE, INITIAL_PIXELS, PIXELS
from ifo_grounding.transforms.base import rows_of
from ifo_grounding.transforms.reward import RewardTransform, last_part, numbers


class GoalReward(RewardTransform):
    """Pays the probability that the instruction is fulfilled, when the policy stops.

    An extension of the paper. The goal classifier sees the first image of the episode, the image
    after the step, and the instruction; it assumes that demonstrations end in success. Steps before
    the stop are paid nothing, and so are episodes that are cut. The transform carries the first
    image as ``initial_pixels``. All else is as of :class:`~ifo_grounding.transforms.LearnedReward`.

    Args:
        goal_classifier: TensorDictModule to a logit from ``pixels``, the image after the step, and
            mostly ``initial_pixels`` and ``instruction``.
        stop_action: number of the action by which the policy ends an episode. None pays where
            ``("next", "terminated")`` is true.
        arrival: for worlds without a stop: paid is the first step after which the probability is at
            least this, and on an environment the episode terminates there.
        in_keys: entries of a step that are read, in the order of the classifier's own ``in_keys``
            and then the action; by default those themselves and ``action``.

    Raises:
        UserError: as of :class:`~ifo_grounding.transforms.LearnedReward`, on a stop or an arrival
            of another form, and where the environment has no such stop.

    >>> from tensordict import TensorDict
    >>> from tensordict.nn import TensorDictModule
    >>> classifier = TensorDictModule(
    ...     lambda pixels: pixels.flatten(1).float().mean(1, keepdim=True), ["pixels"],
    ...     ["goal_score"])
    >>> after = TensorDict({"pixels": torch.zeros(2, 3, 8, 8, dtype=torch.uint8)}, [2])
    >>> batch = TensorDict({"action": torch.tensor([0, 5]), "next": after}, [2])
    >>> GoalReward(classifier, stop_action=5)(batch)["next", "learned_reward"].tolist()
    [[0.0], [0.5]]
    """

    def __init__(
        self,
        goal_classifier: TensorDictModuleBase,
        stop_action: int | None,
        arrival: float | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(goal_classifier, GOAL_SCORE, in_keys, out_keys, also=[ACTION])
        stop_action = None if stop_action is None else whole("stop_action", stop_action)
        if stop_action is not None and stop_action < 0:
            raise UserError(f"stop_action is an action, from 0 on, got {stop_action}")
        if arrival is not None and not 0.0 < arrival <= 1.0:
            raise UserError(f"arrival is a probability above 0 and at most 1, got {arrival}")
        if arrival is not None and stop_action is not None:
            raise UserError(
                "arrival is for worlds without a stop: give it with stop_action=None, or not at all"
            )
        self.stop_action, self.arrival = stop_action, arrival
        roles = [last_part(name) for name in self._names[:-1]]
        if PIXELS not in roles:
            raise UserError(
                f"a goal classifier reads {PIXELS!r}, the image after the step; this one reads "
                f"{self._names[:-1]}: rename its in_keys, and say with in_keys= where they are"
            )
        self.pixels_key = self.in_keys[roles.index(PIXELS)]
        carried = INITIAL_PIXELS in roles
        self.initial_pixels_key = self.in_keys[roles.index(INITIAL_PIXELS)] if carried else None

    def pay(self, before: TensorDictBase, after: TensorDictBase) -> Tensor:
        """Return the reward, float32 [*B, 1], of steps [*B] and what they led to [*B]."""
        ends = self._ends(before, after)
        asked = ends.nonzero().squeeze(-1)
        reward = torch.zeros(len(ends), dtype=torch.float32, device=ends.device)
        reward[asked] = self._score([
            rows_of(after if key == self.pixels_key else before, key)[asked]
            for key in self.in_keys[:-1]
        ]).sigmoid()  # fmt: skip
        if self.arrival is not None:
            reward = reward.where(reward >= self.arrival, 0.0)
        return reward.view(*before.batch_size, 1)

    def _ends(self, before: TensorDictBase, after: TensorDictBase) -> Tensor:
        """Steps after which the classifier is asked, bool [R]."""
        if self.arrival is not None:
            pixels = rows_of(after, self.pixels_key)
            return torch.ones(len(pixels), dtype=torch.bool, device=pixels.device)
        if self.stop_action is None:
            return rows_of(after, "terminated").flatten().bool()
        return numbers(rows_of(before, self.in_keys[-1])).flatten() == self.stop_action

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Rows that do not begin keep what they had: the environment merges by its mask.
        if self.initial_pixels_key is not None:
            first = tensordict_reset.get(self.pixels_key)
            tensordict_reset.set(self.initial_pixels_key, first.clone())
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if (key := self.initial_pixels_key) is not None:
            next_tensordict.set(key, tensordict.get(key))
        super()._step(tensordict, next_tensordict)
        if self.arrival is not None:
            reached = next_tensordict.get(self.out_keys[0]) > 0
            for flag_key in self.parent.done_keys:
                if last_part(flag_key) != "truncated":
                    flag = next_tensordict.get(flag_key)
                    next_tensordict.set(flag_key, flag | reached.view_as(flag))
        return next_tensordict

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Declare the learned reward beside the true one."""
        if self.stop_action is not None and self.parent is not None:
            count = getattr(self.parent.full_action_spec.get(self.in_keys[-1], None), "n", None)
            if isinstance(count, int) and self.stop_action >= count:
                raise UserError(
                    f"stop_action={self.stop_action} is no action of the environment, whose "
                    f"actions are 0..{count - 1}"
                )
            own = attribute(self.container, "stop_action")
            if own not in (None, self.stop_action):
                raise UserError(
                    f"stop_action={self.stop_action} does not end an episode of this environment: "
                    f"its own stop_action is {own}"
                )
        return super().transform_reward_spec(reward_spec)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declare the first image of the episode."""
        if (key := self.initial_pixels_key) is not None:
            observation_spec[key] = observation_spec[self.pixels_key].clone()
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Declare what a step reads (batched environments send it to workers)."""
        state_spec = super().transform_state_spec(state_spec)
        if (key := self.initial_pixels_key) is not None:
            state_spec[key] = self.parent.full_observation_spec[self.pixels_key].clone()
        return state_spec
