"""Keeping the best policy by what a learner can measure itself."""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.episodes import play
from ifo_grounding.errors import UserError
from ifo_grounding.modules import evaluating
from ifo_grounding.seeding import derive
from ifo_grounding.training.early_stopping import BestWeights
from ifo_grounding.training.held_out_accuracy import HeldOutAccuracy
from ifo_grounding.training.loop import Metrics
from ifo_grounding.training.reseeding import fixes_scenes, reseed, sampler_stats, transforms_of

RETURN = "selection_return"
"""Metric: mean learned return of the greedy policy, always from the same starts."""
ACCURACY = "held_out_accuracy"
"""Metric: share of the held-out demonstrations' actions that the greedy policy takes."""


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
    rows, found = env.batch_size.numel(), []
    for _ in range(math.ceil(episodes / rows)):
        total = torch.zeros(rows, device=env.device)

        def add(running: Tensor, transition: TensorDictBase, total: Tensor = total) -> None:
            total[running] += transition[keys.NEXT, keys.LEARNED_REWARD].reshape(-1)

        play(policy, env, env.reset(), max_steps=max_steps, on_step=add)
        found.append(total.cpu())
    return torch.cat(found)[:episodes]


class BestCheckpoint(BestWeights):
    """Measures the policy, always on the same episodes, and remembers the best weights.

    The measure is the learned return or, where the reward model changes and returns cannot be
    compared, the accuracy on held-out demonstrations. A policy is kept if its mean is higher than
    the highest one so far by more than ``margin`` standard errors of the paired difference. With 2,
    noise alone seldom replaces what phase 1 has learned. With -1, weights are kept unless they are
    clearly worse (the one-standard-error rule, Breiman et al. 1984): near the ceiling most gains
    are too small to be clear.

    :func:`~ifo_grounding.training.self_examine` makes one as its config says. It also serves
    :func:`~ifo_grounding.training.fit` as ``held_out``.

    Args:
        env: batched; its transforms choose instructions and pay learned rewards.
        policy: plays greedily.
        seed: seed of the starts.
        episodes: how many are played for a measure.
        max_steps: most actions of an episode.
        margin: standard errors by which a policy has to be better to be kept.
        held_out: weights whose accuracy there is clearly worse than at first are never kept.
        by_accuracy: measure the accuracy of ``held_out`` instead of the learned return.

    Raises:
        UserError: for ``by_accuracy`` without ``held_out``.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: nn.Module,
        *,
        seed: int,
        episodes: int = 512,
        max_steps: int = 40,
        margin: float = 2.0,
        held_out: HeldOutAccuracy | None = None,
        by_accuracy: bool = False,
    ) -> None:
        if by_accuracy and held_out is None:
            raise UserError("to choose by accuracy takes demonstrations: give held_out=")
        super().__init__(policy)
        self.env, self.seed = env, seed
        self.episodes, self.max_steps, self.margin = episodes, max_steps, margin
        self.held_out, self.by_accuracy = held_out, by_accuracy
        self.metric = ACCURACY if by_accuracy else RETURN
        self.fixed = [t for t in transforms_of(env) if fixes_scenes(t)]
        self.first_starts = copy.deepcopy([starts.state_dict() for starts in self.fixed])

    def measure(self) -> float:
        """Return the mean of what decides, and remember the weights if it is high enough."""
        return self.consider()[self.metric]

    def consider(self) -> Metrics:
        """Measure the policy, keep its weights if they are good enough, and return metrics."""
        if self.by_accuracy:
            assert self.held_out is not None
            accuracy = self.held_out.measure()
            return {ACCURACY: float(accuracy.mean()), "selected": float(self.keep(accuracy))}
        returns = self._returns()
        found, worse = {RETURN: float(returns.mean())}, False
        if self.held_out:
            found[ACCURACY], worse = self.held_out.compare()
        return {**found, "selected": float(not worse and self.keep(returns))}

    def keep(self, measured: Tensor) -> bool:
        """Remember the policy's present weights if what was measured of them, [N], is enough."""
        gain = torch.ones(1) if self.best is None else measured - self.best
        error = float(gain.std()) / math.sqrt(len(gain)) if len(gain) > 1 else 0.0
        if float(gain.mean()) <= self.margin * error:
            return False
        self.remember(measured.clone() if float(gain.mean()) > 0 else self.best)
        return True

    def _returns(self) -> Tensor:
        """Measure the learned returns, always from the same starts, and leave all else as it is."""
        present = copy.deepcopy([starts.state_dict() for starts in self.fixed])
        for starts, first in zip(self.fixed, self.first_starts, strict=True):
            starts.load_state_dict(copy.deepcopy(first))
        with evaluating(self.module), torch.random.fork_rng(devices=[]):
            reseed(self.env, derive(self.seed, "self-examination", "selection"))
            returns = learned_returns(self.env, self.module, self.episodes, self.max_steps)
        sampler_stats(self.env)  # forgets what was counted meanwhile
        for starts, state in zip(self.fixed, present, strict=True):
            starts.load_state_dict(state)
        return returns

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint has to keep."""
        held_out = {"held_out": self.held_out.first} if self.held_out else {}
        return {**super().state_dict(), **held_out, "first_starts": self.first_starts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        super().load_state_dict(state)
        self.first_starts = state["first_starts"]
        if self.held_out:
            self.held_out.first = state["held_out"]
