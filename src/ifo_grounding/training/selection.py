"""Which weights are kept in the end: those with the best measure that a learner can take itself."""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from ifo_grounding import keys
from ifo_grounding.episodes import play
from ifo_grounding.errors import UserError
from ifo_grounding.modules import beside, evaluating, exploring
from ifo_grounding.seeding import derive
from ifo_grounding.training.loop import Metrics
from ifo_grounding.training.reseeding import reseed, sampler_stats, stored_starts
from ifo_grounding.training.updates import total_loss

CLEARLY = 2.0
AT_ONCE = 1024
"""Held-out samples that are measured together, to bound memory."""


class BestWeights:
    """The weights of a module that did best so far, by whatever a subclass measures."""

    every = 4
    """Iterations of :func:`~ifo_grounding.training.fit` between two measures."""

    def __init__(self, module: nn.Module) -> None:
        self.module = module
        self.best: Tensor | None = None
        self.weights: dict[str, Tensor] = {}

    def measure(self) -> Metrics:
        """Measure the module, remember its weights if they do better, and return metrics."""
        raise NotImplementedError

    def remember(self, best: Tensor | None) -> None:
        """Remember the present weights, and what was measured of the best ones."""
        self.best, self.weights = best, copy.deepcopy(self.module.state_dict())

    def restore(self) -> None:
        """Give the module its best weights back, where there are any."""
        if self.weights:
            self.module.load_state_dict(self.weights)

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint has to keep."""
        return {"best": self.best, "weights": self.weights}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.best, self.weights = state["best"], state["weights"]


class EarlyStopping(BestWeights):
    """Measures a loss on held-out samples and remembers the weights that did best.

    :func:`~ifo_grounding.training.fit` measures every few iterations and brings the best weights
    back in the end: early stopping without a patience to choose.

    Args:
        loss: the LossModule that is trained; it is measured in eval mode.
        buffer: held-out samples, all of which are measured.

    >>> from ifo_grounding.data import Demonstrations, first_frame_buffer
    >>> from ifo_grounding.networks import make_instruction_classifier
    >>> from ifo_grounding.objectives import InstructionLoss
    >>> frames = [torch.zeros(3, 3, 48, 48, dtype=torch.uint8) for _ in range(8)]
    >>> demos = Demonstrations.from_arrays(frames, ["go up", "go down"] * 4)
    >>> loss = InstructionLoss(make_instruction_classifier(demos, seed=0), demos.pool())
    >>> early_stopping = EarlyStopping(loss, first_frame_buffer(demos))
    >>> early_stopping.measure()["held_out_loss"] == early_stopping.best.item()
    True
    """

    def __init__(self, loss: nn.Module, buffer: ReplayBuffer) -> None:
        super().__init__(loss)
        self.buffer = _held_out(buffer)

    def measure(self) -> Metrics:
        """Return the loss on all samples, and remember the weights if it is the lowest so far."""
        total = 0.0
        with evaluating(self.module), torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # the same negatives every time
            for rows in torch.arange(len(self.buffer)).split(AT_ONCE):
                losses = self.module(beside(self.buffer[rows], self.module))
                total += float(total_loss(losses)) * len(rows)
        mean = total / len(self.buffer)
        if self.best is None or mean < self.best:
            self.remember(torch.tensor(mean, dtype=torch.float64))
        return {"held_out_loss": mean}


class HeldOutAccuracy:
    """Compares the greedy actions of a policy with the labels of held-out demonstrations.

    A learned reward may take the policy's own mistakes for success. Self-examination then makes
    them more frequent while the learned return rises; the accuracy on held-out demonstrations falls
    below what it was at first. It is a warning, no estimate of success: which of two shortest paths
    a demonstrator took is chance, and the learned rewards are trained on all demonstrations.

    Args:
        policy: acts greedily.
        buffer: held-out transitions, as :func:`~ifo_grounding.data.labelled_buffer` makes them.

    >>> from ifo_grounding.data import labelled_buffer, record_demonstrations
    >>> from ifo_grounding.networks import make_policy
    >>> demos, truth = record_demonstrations("move", 4, seed=0, keep_truth=True)
    >>> accuracy = HeldOutAccuracy(make_policy(demos), labelled_buffer(demos, truth.actions))
    >>> accuracy.measure().shape
    torch.Size([4])
    """

    def __init__(self, policy: TensorDictModuleBase, buffer: ReplayBuffer) -> None:
        self.policy, self.buffer = policy, _held_out(buffer)
        self.first: Tensor | None = None

    def measure(self) -> Tensor:
        """Return the share of each demonstration's actions that the policy takes, float32 [D]."""
        right, final = [], []
        with evaluating(self.policy), exploring(ExplorationType.DETERMINISTIC):
            for rows in torch.arange(len(self.buffer)).split(AT_ONCE):
                seen = beside(self.buffer[rows], self.policy)
                label = seen.pop(keys.ACTION)
                right.append((self.policy(seen)[keys.ACTION] == label).float().cpu())
                final.append(seen[keys.FINAL].squeeze(-1).long().cpu())
        ended = torch.cat(final)
        demonstration = ended.cumsum(0) - ended
        counted = torch.stack([torch.cat(right), torch.ones(len(ended))])
        total = torch.zeros(2, int(demonstration[-1]) + 1).index_add_(1, demonstration, counted)
        return total[0] / total[1]

    def compare(self) -> tuple[float, bool]:
        """Return the mean accuracy, and whether it is clearly below that of the first call.

        That is by more than ``CLEARLY`` standard errors of the paired difference.
        """
        accuracy = self.measure()
        if self.first is None:
            self.first = accuracy
        change = accuracy - self.first
        return float(accuracy.mean()), float(change.mean()) < -CLEARLY * _error(change)


class BestCheckpoint(BestWeights):
    """Measures a policy, always on the same episodes, and remembers the best weights.

    The measure is the learned return or, where the reward model changes and returns cannot be
    compared, the accuracy on held-out demonstrations. A policy is kept if its mean is higher than
    the highest one so far by more than ``margin`` standard errors of the paired difference. With 2,
    noise alone seldom replaces what phase 1 has learned. With -1, weights are kept unless they are
    clearly worse (the one-standard-error rule, Breiman et al. 1984).

    :func:`~ifo_grounding.training.self_examine` makes one as its config says. It also serves
    :func:`~ifo_grounding.training.fit` as ``held_out``.

    Args:
        env: batched; its transforms choose instructions and pay learned rewards.
        policy: plays greedily.
        episodes: how many are played for a measure.
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
            raise UserError(
                "the best policy is selected by its accuracy on held-out demonstrations, since "
                "adversarial updates change what returns mean: give held_out=, or select_every=0"
            )
        super().__init__(policy)
        self.env, self.seed = env, seed
        self.episodes, self.max_steps, self.margin = episodes, max_steps, margin
        self.held_out, self.by_accuracy = held_out, by_accuracy
        self.starts = stored_starts(env)
        self.first_starts = copy.deepcopy([starts.state_dict() for starts in self.starts])

    def measure(self) -> Metrics:
        """Measure the policy, keep its weights if they are good enough, and return metrics."""
        if self.by_accuracy:
            assert self.held_out is not None
            accuracy = self.held_out.measure()
            return {
                "held_out_accuracy": float(accuracy.mean()),
                "selected": float(self.keep(accuracy)),
            }
        returns = self._returns()
        found, worse = {"selection_return": float(returns.mean())}, False
        if self.held_out:
            found["held_out_accuracy"], worse = self.held_out.compare()
        return {**found, "selected": float(not worse and self.keep(returns))}

    def keep(self, measured: Tensor) -> bool:
        """Remember the policy's present weights if what was measured of them, [N], is enough."""
        gain = torch.ones(1) if self.best is None else measured - self.best
        error = _error(gain) if len(gain) > 1 else 0.0
        if float(gain.mean()) <= self.margin * error:
            return False
        self.remember(measured.clone() if float(gain.mean()) > 0 else self.best)
        return True

    def _returns(self) -> Tensor:
        """Measure the learned returns, always from the same starts, and leave all else as it is."""
        present = copy.deepcopy([starts.state_dict() for starts in self.starts])
        for starts, first in zip(self.starts, self.first_starts, strict=True):
            starts.load_state_dict(copy.deepcopy(first))
        with evaluating(self.module), torch.random.fork_rng(devices=[]):
            reseed(self.env, derive(self.seed, "self-examination", "selection"))
            returns = learned_returns(self.env, self.module, self.episodes, self.max_steps)
        sampler_stats(self.env)  # forgets what was counted meanwhile
        for starts, state in zip(self.starts, present, strict=True):
            starts.load_state_dict(state)
        return returns

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint has to keep."""
        first = self.held_out.first if self.held_out else None
        return {**super().state_dict(), "held_out": first, "first_starts": self.first_starts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        super().load_state_dict(state)
        self.first_starts = state["first_starts"]
        if self.held_out:
            self.held_out.first = state["held_out"]


def learned_returns(env: EnvBase, policy: nn.Module, episodes: int, max_steps: int) -> Tensor:
    """Play one episode per chosen start and add up its learned rewards, float32 [episodes].

    Whole batches of the env are played, and the rest of the last one is left out. After
    ``max_steps`` an episode counts as it is.
    """
    rows, found = env.batch_size.numel(), []
    for _ in range(math.ceil(episodes / rows)):
        total = torch.zeros(rows, device=env.device)

        def add(running: Tensor, transition: TensorDictBase, total: Tensor = total) -> None:
            total[running] += transition[keys.NEXT, keys.LEARNED_REWARD].reshape(-1)

        play(policy, env, env.reset(), max_steps=max_steps, on_step=add)
        found.append(total.cpu())
    return torch.cat(found)[:episodes]


def _held_out(buffer: ReplayBuffer) -> ReplayBuffer:
    if not len(buffer):
        raise UserError("there are no held-out samples: hold a larger share out")
    return buffer


def _error(values: Tensor) -> float:
    """Return the standard error of a mean, infinite for that of a single value."""
    return float(values.std()) / math.sqrt(len(values)) if len(values) > 1 else math.inf
