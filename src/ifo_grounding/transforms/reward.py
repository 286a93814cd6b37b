"""A reward from learned judges, beside the true one."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, nan

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, Transform

from ifo_grounding.attributes import stop_of
from ifo_grounding.errors import UserError, check_choice, whole
from ifo_grounding.keys import (
    ACTION,
    ACTION_SCORE,
    GOAL_SCORE,
    INITIAL_PIXELS,
    LEARNED_REWARD,
    NEXT,
    PIXELS,
)
from ifo_grounding.modules import device_of, evaluating, output_key
from ifo_grounding.transforms._common import EpisodeTransform, flat_logit, parts_of

FROM_ENV = "env"
KINDS = ("action", "goal", "both")
FORMS = ("probability", "centred", "log-odds")
ROWS_AT_ONCE = 4096
"""Rows that a judge scores together, to bound memory."""


class LearnedReward(EpisodeTransform):
    """Pays every step what a learned judge thinks of it; the true reward stays where it is.

    ``kind="action"`` is the paper's reward module ``rwd(s, t, a)``: the probability that the action
    is right for the state and the instruction. ``kind="goal"`` is an extension: a judge of (first
    frame, last frame, instruction) pays its probability when the policy stops, and nothing before.
    It assumes that demonstrations end in success. ``kind="both"`` adds the two, weighted.

    Used on an environment it writes ``("next", "learned_reward")`` after every step; called on a
    tensordict, or appended to a replay buffer, it relabels steps that were collected before. The
    judges move with the environment's device; their mode (train or eval) is left as it is.

    Args:
        model: TensorDictModule that writes a logit: the judge of actions, or that of goals where
            ``kind="goal"``. Its ``in_keys`` are read.
        kind: ``action``, ``goal`` or ``both``.
        reward_key: key of the reward, below ``next``.
        form: of the action's reward: ``probability`` p (paper), ``centred`` p - 0.5, or
            ``log-odds`` log(p / (1 - p)).
        goal_model: the judge of goals where ``kind="both"``.
        weights: of the action's and of the goal's reward.
        stop_action: the action that ends an episode by the policy's will, at which a goal is paid;
            by default what the environment names as its ``stop_action`` (:meth:`ask` it, for
            batches that were collected there). None pays the goal where ``("next", "terminated")``
            is true.
        arrival: for worlds without a stop: a goal is paid at the first step after which its judge's
            probability is at least this, and on an environment the episode terminates there.
        pixels_key: key of the image, which the judge of goals is shown as it is after the step.
        initial_pixels_key: key of the first image of the episode, which the transform carries.
        action_key: key of the action.

    Raises:
        UserError: on an unknown kind or form, or a judge of another form; where goals are to be
            paid and nobody says which action is the stop; where a later transform changes what a
            judge reads.

    >>> from tensordict.nn import TensorDictModule
    >>> model = TensorDictModule(lambda action: (action * 0.0).unsqueeze(-1), ["action"],
    ...                          ["action_score"])
    >>> batch = TensorDict({"action": torch.tensor([0, 3])}, [2])
    >>> LearnedReward(model)(batch)["next", "learned_reward"].tolist()
    [[0.5], [0.5]]
    """

    def __init__(
        self,
        model: TensorDictModuleBase,
        kind: str = "action",
        reward_key: NestedKey = LEARNED_REWARD,
        form: str = "probability",
        goal_model: TensorDictModuleBase | None = None,
        weights: Sequence[float] = (1.0, 1.0),
        stop_action: int | str | None = FROM_ENV,
        arrival: float | None = None,
        pixels_key: NestedKey = PIXELS,
        initial_pixels_key: NestedKey = INITIAL_PIXELS,
        action_key: NestedKey = ACTION,
    ) -> None:
        check_choice("kind", kind, KINDS)
        check_choice("form", form, FORMS)
        if (goal_model is None) == (kind == "both"):
            raise UserError("goal_model is for kind='both', which needs it as its second judge")
        if kind == "goal" and form != "probability":
            raise UserError(f"form={form!r} is for the action's reward: a goal pays a probability")
        try:
            self.action_weight, self.goal_weight = map(float, weights)
        except (TypeError, ValueError):
            self.action_weight = self.goal_weight = nan
        if not isfinite(self.action_weight + self.goal_weight):
            raise UserError(
                f"weights are two numbers, of the action and of the goal, got {weights!r}"
            )
        if isinstance(stop_action, str):
            check_choice("stop_action", stop_action, (FROM_ENV,))
        elif stop_action is not None:
            try:
                stop_action = whole("stop_action", stop_action)
            except UserError:
                raise UserError(
                    f"stop_action is the number of an action, {FROM_ENV!r} or None, got "
                    f"{stop_action!r}"
                ) from None
            if stop_action < 0:
                raise UserError(f"stop_action is an action, from 0 on, got {stop_action}")
        if arrival is not None and (kind == "action" or not 0.0 < arrival <= 1.0):
            raise UserError(
                f"arrival is a probability of the judge of goals, within 0..1, got {arrival} with "
                f"kind={kind!r}"
            )
        self.kind, self.form, self.stop_action, self.arrival = kind, form, stop_action, arrival
        action_judge = None if kind == "goal" else model
        goal_judge = model if kind == "goal" else goal_model
        self.pixels_key = unravel_key(pixels_key)
        self.initial_pixels_key = unravel_key(initial_pixels_key)
        self.action_key = unravel_key(action_key)
        self.reward_key = unravel_key(reward_key)
        inputs: list[NestedKey] = []
        if action_judge is not None:
            self.action_logit = output_key(action_judge, ACTION_SCORE)
            inputs += [unravel_key(key) for key in action_judge.in_keys]
        if goal_judge is not None:
            self.goal_logit = output_key(goal_judge, GOAL_SCORE)
            shown = [unravel_key(key) for key in goal_judge.in_keys]
            if self.pixels_key not in shown:
                raise UserError(
                    f"the judge of goals reads {shown}: say which of them is the image after the "
                    f"step with pixels_key=, it is not {self.pixels_key!r}"
                )
            inputs += shown
        super().__init__(in_keys=list(dict.fromkeys(inputs)), out_keys=[self.reward_key])
        self.action_judge, self.goal_judge = action_judge, goal_judge
        self._named: int | None = None
        """The stop of the environment, once it was asked for."""

    @property
    def judges_goals(self) -> bool:
        """Whether the first image of the episode is carried along."""
        return self.goal_judge is not None

    def set_container(self, container: Transform | EnvBase) -> None:
        """Belong to an environment, which is asked for its stop when it is needed."""
        super().set_container(container)
        if self._lives_in_an_environment():
            self._named = None

    def _lives_in_an_environment(self) -> bool:
        try:
            return self.container is not None
        except ValueError:  # how TorchRL says that it is in something else, such as a buffer
            return False

    def ask(self, env: EnvBase) -> LearnedReward:
        """Ask an environment for its stop where that matters, to pay batches collected there."""
        if self.judges_goals and self.stop_action == FROM_ENV and self.arrival is None:
            self._named = stop_of(env, type(self).__name__)
        return self

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Rows that do not begin keep what they had: the environment merges by its mask.
        if self.judges_goals:
            first = tensordict_reset.get(self.pixels_key)
            tensordict_reset.set(self.initial_pixels_key, first.clone())
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._check_place()
        if self.judges_goals:
            first = tensordict.get(self.initial_pixels_key)
            next_tensordict.set(self.initial_pixels_key, first)
        reward, arrived = self.pay(tensordict, next_tensordict)
        if self.arrival is not None:
            for key in self.parent.done_keys:
                if (key if isinstance(key, str) else key[-1]) != "truncated":
                    flag = next_tensordict.get(key)
                    next_tensordict.set(key, flag | arrived.view_as(flag))
        return next_tensordict.set(self.reward_key, reward)

    def _check_place(self) -> None:
        """Refuse what later transforms have made of entries that the judges read.

        A step is given what they have made of the last observation already.
        """
        beside = getattr(self.container, "transform", None)
        parts = [] if beside is None else parts_of(beside)
        later = parts[parts.index(self) + 1 :] if self in parts else []
        written = {unravel_key(key) for part in later for key in part.out_keys or []}
        if not written.isdisjoint(self.in_keys):
            shown = self.parent.full_observation_spec.keys(True, True)
            if changed := written & set(self.in_keys) & set(shown):
                raise UserError(
                    f"a transform after {type(self).__name__} changes {sorted(map(str, changed))}, "
                    "which its judge reads: put it before, or let it write to other out_keys"
                )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relabel collected steps, a tensordict [*B], with ``("next", "learned_reward")``.

        With ``arrival`` every step after which the goal looks reached is paid for it: only on an
        environment does the episode end at the first.

        Raises:
            UserError: where an entry that a judge reads is missing.
        """
        if tensordict.get(NEXT, None) is None:
            tensordict.set(NEXT, tensordict.empty())
        after = tensordict.get(NEXT)
        after.set(self.reward_key, self.pay(tensordict, after)[0])
        return tensordict

    def pay(self, before: TensorDictBase, after: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Reward of steps, float32 [*B, 1], and which of them are paid for their goal, [*B, 1]."""
        batch = before.batch_size
        rows = batch.numel()
        reward: Tensor | float = 0.0
        reached = torch.zeros(rows, dtype=torch.bool)
        if self.action_judge is not None:
            entries = {key: self._rows(before, key) for key in self.action_judge.in_keys}
            for key in entries:
                if unravel_key(key) == self.action_key:
                    entries[key] = numbers(entries[key])
            logit = self._score(self.action_judge, self.action_logit, entries, rows)
            reward = reward + self.action_weight * formed(logit, self.form)
        if self.goal_judge is not None:
            goal, reached = self._goal_reward(before, after, rows)
            reward = reward + self.goal_weight * goal
        assert isinstance(reward, Tensor)
        return reward.view(*batch, 1), reached.view(*batch, 1)

    def _goal_reward(
        self, before: TensorDictBase, after: TensorDictBase, rows: int
    ) -> tuple[Tensor, Tensor]:
        """What the judge of goals pays [rows], and where it does, bool [rows]."""
        assert self.goal_judge is not None
        judged = self._judged(before, after, rows)
        asked = judged.nonzero().squeeze(-1)
        entries = {
            key: self._rows(after if unravel_key(key) == self.pixels_key else before, key)[asked]
            for key in self.goal_judge.in_keys
        }
        reward = torch.zeros(rows, dtype=torch.float32, device=judged.device)
        if len(asked):
            logit = self._score(self.goal_judge, self.goal_logit, entries, len(asked))
            reward[asked] = logit.sigmoid()
        if self.arrival is not None:
            judged = reward >= self.arrival
            reward = reward.where(judged, 0.0)
        return reward, judged

    def _judged(self, before: TensorDictBase, after: TensorDictBase, rows: int) -> Tensor:
        """After which steps the judge of goals is asked, bool [rows]."""
        if self.arrival is not None:
            return torch.ones(
                rows, dtype=torch.bool, device=self._rows(after, self.pixels_key).device
            )
        if self.stop_action is None:
            return self._rows(after, "terminated").reshape(rows).bool()
        return numbers(self._rows(before, self.action_key)).reshape(rows) == self._stop

    @property
    def _stop(self) -> int:
        if isinstance(self.stop_action, int):
            return self.stop_action
        if self._named is None:
            env = self.parent if self._lives_in_an_environment() else None
            self._named = stop_of(env, type(self).__name__)
        return self._named

    def _rows(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            hint = (
                ": collect with LearnedReward on the environment, which carries it"
                if unravel_key(key) == self.initial_pixels_key
                else f": the tensordict has {sorted(map(str, tensordict.keys(True, True)))}"
            )
            raise UserError(f"{type(self).__name__} needs the entry {key!r}{hint}")
        batch = tensordict.batch_size
        return value.reshape(batch.numel(), *value.shape[len(batch) :])

    def _score(
        self,
        judge: TensorDictModuleBase,
        name: NestedKey,
        entries: dict[NestedKey, Tensor],
        rows: int,
    ) -> Tensor:
        """Logits [rows], on the device of the entries."""
        home = next(iter(entries.values())).device
        if not rows:
            return torch.zeros(0, device=home)
        device = device_of(judge) or home
        batch = TensorDict({}, batch_size=[rows])
        for key, value in entries.items():
            batch.set(key, value)
        with evaluating(judge):
            parts = [
                flat_logit(judge(part.to(device)).get(name), len(part), name)
                for part in batch.split(ROWS_AT_ONCE)
            ]
        return torch.cat(parts).to(home)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Declare the learned reward beside the true one.

        Raises:
            UserError: where the environment pays a reward of that name already, or has no such
                stop.
        """
        if self.reward_key in reward_spec.keys(True, True):
            raise UserError(
                f"the environment pays {self.reward_key!r} already, which stays where it is: give "
                "another reward_key, and tell losses with set_keys(reward=...)"
            )
        if isinstance(self.stop_action, int) and self.parent is not None:
            count = getattr(self.parent.full_action_spec.get(self.action_key, None), "n", None)
            if isinstance(count, int) and self.stop_action >= count:
                raise UserError(
                    f"stop_action={self.stop_action} is no action of the environment, whose "
                    f"actions are 0..{count - 1}"
                )
        reward_spec[self.reward_key] = Unbounded(
            shape=(*reward_spec.shape, 1), dtype=torch.float32, device=reward_spec.device
        )
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declare the first image of the episode where goals are judged."""
        if self.judges_goals:
            observation_spec[self.initial_pixels_key] = observation_spec[self.pixels_key].clone()
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Declare what a step reads (batched environments send it to workers)."""
        observations = self.parent.full_observation_spec
        names = set(observations.keys(True, True))
        for key in set(self.in_keys) & names - set(state_spec.keys(True, True)):
            state_spec[key] = observations[key].clone()
        if self.judges_goals:
            state_spec[self.initial_pixels_key] = observations[self.pixels_key].clone()
        return state_spec


def numbers(action: Tensor) -> Tensor:
    """Return the numbers of actions, which may be one-hot.

    >>> numbers(torch.tensor([[0, 0, 1], [1, 0, 0]])).tolist()
    [2, 0]
    """
    if action.ndim < 2 or action.shape[-1] == 1:
        return action
    return (action.byte() if action.dtype == torch.bool else action).argmax(-1)


def formed(logit: Tensor, form: str) -> Tensor:
    """Turn the logit of an action into its reward.

    >>> formed(torch.tensor([0.0]), "centred").item()
    0.0
    """
    if form == "log-odds":
        return logit
    probability = logit.sigmoid()
    return probability - 0.5 if form == "centred" else probability
