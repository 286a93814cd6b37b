"""Keeping the best policy by what the learner itself can measure."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.episodes import play
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import derive
from ifo_grounding.training.environment import (
    fixes_scenes,
    reseed,
    sampler_stats,
    transforms_of,
)
from ifo_grounding.training.guard import Guard
from ifo_grounding.training.supervised import Metrics

AGREEMENT = "agreement"
"""Metric: share of the guard's demonstrations' actions that the greedy policy would take."""


@torch.no_grad()
def learned_returns(env: EnvBase, policy: nn.Module, episodes: int, max_steps: int) -> Tensor:
    """Play one episode per chosen start and add up its learned rewards.

    Args:
        env: batched; its transforms choose instructions and pay learned rewards.
        policy: plays greedily.
        episodes: how many, rounded up to whole batches of the env.
        max_steps: after which an episode counts as it is.

    Returns:
        Learned return of each episode, float32 [episodes].
    """
    rows = env.batch_size.numel()
    found = []
    for _ in range(math.ceil(episodes / rows)):
        total = torch.zeros(rows, device=env.device)

        def add(running: Tensor, transition: TensorDictBase, total: Tensor = total) -> None:
            total[running] += transition[keys.NEXT, keys.LEARNED_REWARD].reshape(-1)

        play(policy, env, env.reset(), max_steps=max_steps, on_step=add)
        found.append(total.cpu())
    return torch.cat(found)[:episodes]


class BestPolicy:
    """Remembers weights with a high learned return on the same starts.

    A policy is kept if its mean return is higher than the highest one so far by more than
    ``margin`` standard errors of the paired difference. With 2, noise alone seldom replaces what
    phase 1 has learned. With -1, practice goes on unless it clearly harms (the one-standard-error
    rule, Breiman et al. 1984): near the ceiling most gains are too small to be clear.

    >>> layer = nn.Linear(1, 1, bias=False)
    >>> best = BestPolicy(layer, margin=2.0)
    >>> best.consider(torch.tensor([0.0, 1.0])), best.consider(torch.tensor([1.0, 0.0]))
    (True, False)
    >>> best.consider(torch.tensor([1.0, 1.5]))
    True
    """

    def __init__(self, policy: nn.Module, margin: float) -> None:
        self.policy, self.margin = policy, margin
        self.weights: dict[str, Tensor] = {}
        self.returns: Tensor | None = None

    def consider(self, returns: Tensor) -> bool:
        """Keep the policy's present weights if their returns [N] are high enough."""
        gain = torch.ones(1) if self.returns is None else returns - self.returns
        error = float(gain.std()) / math.sqrt(len(gain)) if len(gain) > 1 else 0.0
        if float(gain.mean()) <= self.margin * error:
            return False
        if float(gain.mean()) > 0:
            self.returns = returns.clone()
        self.weights = copy.deepcopy(self.policy.state_dict())
        return True

    def restore(self) -> None:
        """Give the policy the best weights back, where there are any."""
        if self.weights:
            self.policy.load_state_dict(self.weights)

    def state_dict(self) -> dict[str, Any]:
        """Return the best weights and their returns."""
        return {"weights": self.weights, "returns": self.returns}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.weights, self.returns = state["weights"], state["returns"]


@dataclass(frozen=True)
class SelectionSchedule:
    """When to look at the policy, and for how long."""

    every: int
    """Iterations between two looks; 0 never looks."""
    iterations: int
    """Iterations of the run: the last one is always looked at."""
    episodes: int
    """Episodes of each look."""
    max_steps: int
    """Most actions of an episode."""
    margin: float
    """Of :class:`BestPolicy`."""


class Selection:
    """Measures the policy, always on the same episodes, and keeps the best weights.

    The measure is the learned return or, where the judge changes, agreement with demonstrations.

    Self-examination asks it from time to time; it also serves :func:`~ifo_grounding.training.fit`
    as ``held_out``, so that other training can stop by the same rule.

    Args:
        env: batched; its transforms choose instructions and pay learned rewards.
        policy: plays greedily.
        schedule: when to look, and for how long.
        seed: of the starts.
        guard: refuses weights with which the policy goes astray, whatever their return.
        by_agreement: choose by the agreement with the guard's demonstrations instead of the learned
            return, which says nothing from one look to the next where the judge is trained on.

    Raises:
        UserError: where a choice by agreement has no guard.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: nn.Module,
        schedule: SelectionSchedule,
        seed: int,
        guard: Guard | None = None,
        by_agreement: bool = False,
    ) -> None:
        if by_agreement and guard is None:
            raise UserError("a choice by agreement needs a guard, which holds the demonstrations")
        self.env, self.policy, self.schedule, self.seed = env, policy, schedule, seed
        self.guard, self.by_agreement = guard, by_agreement
        self.metric = AGREEMENT if by_agreement else "selection_return"
        self.best = BestPolicy(policy, schedule.margin)
        self.fixed = [t for t in transforms_of(env) if fixes_scenes(t)]
        self.first_starts = copy.deepcopy([starts.state_dict() for starts in self.fixed])

    def after(self, done: int) -> Metrics:
        """Measure and consider the policy after some iterations, if it is time to."""
        schedule = self.schedule
        last = done == schedule.iterations
        if not schedule.every or (done % schedule.every and not last):
            return {}
        return self._consider()

    def look(self) -> float:
        """Return the mean of what decides, and remember the weights if it is high enough."""
        return self._consider()[self.metric]

    def _consider(self) -> Metrics:
        if self.by_agreement:
            assert self.guard is not None
            agreement = self.guard.agreement()
            selected = self.best.consider(agreement)
            return {AGREEMENT: float(agreement.mean()), "selected": float(selected)}
        returns = self._returns()
        found = {self.metric: float(returns.mean())}
        astray = False
        if self.guard:
            found[AGREEMENT], astray = self.guard.look()
        return {**found, "selected": float(not astray and self.best.consider(returns))}

    def _returns(self) -> Tensor:
        """Measure the learned returns, always from the same starts, and leave all else as it is."""
        schedule = self.schedule
        present = copy.deepcopy([starts.state_dict() for starts in self.fixed])
        for starts, first in zip(self.fixed, self.first_starts, strict=True):
            starts.load_state_dict(copy.deepcopy(first))
        training = self.policy.training
        self.policy.eval()
        with torch.random.fork_rng(devices=[]):
            reseed(self.env, derive(self.seed, "self-examination", "selection"))
            returns = learned_returns(self.env, self.policy, schedule.episodes, schedule.max_steps)
        self.policy.train(training)
        sampler_stats(self.env)
        for starts, state in zip(self.fixed, present, strict=True):
            starts.load_state_dict(state)
        return returns

    def restore(self) -> None:
        """Give the policy the best weights back."""
        self.best.restore()

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint has to keep."""
        guard = {"guard": self.guard.state_dict()} if self.guard else {}
        return {**self.best.state_dict(), **guard, "first_starts": self.first_starts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.best.load_state_dict(state)
        self.first_starts = state.get("first_starts", self.first_starts)  # older ones lack them
        if self.guard:
            self.guard.load_state_dict(state["guard"])
