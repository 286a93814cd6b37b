"""Trials of several initial weights, of which the best ones learn on: successive halving."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl.data import ReplayBuffer

from ifo_grounding.objectives import SupervisedLoss
from ifo_grounding.progress import progress_bar
from ifo_grounding.seeding import derive
from ifo_grounding.training.loop import Log, Metrics
from ifo_grounding.training.supervised import FitConfig, fit


def trial_seed(seed: int, number: int) -> int:
    """Return the seed of the initial weights of a trial; the first has the seed of the run.

    >>> trial_seed(7, 0)
    7
    """
    return derive(seed, "beginning", number) if number else seed


class Trial:
    """One of several initial weights of a network, trained for some steps and on from there.

    Args:
        loss: loss of a network with these weights (see :func:`trial_seed`).
        checkpoint: file of this trial (see :meth:`ifo_grounding.training.run.Stage.trial`).
        options: further options of :func:`~ifo_grounding.training.fit`, such as ``seed`` and
            ``held_out``.
    """

    def __init__(
        self,
        number: int,
        loss: SupervisedLoss,
        buffer: ReplayBuffer,
        config: FitConfig,
        checkpoint: str | Path,
        **options: Any,
    ) -> None:
        self.number, self.loss, self.buffer, self.config = number, loss, buffer, config
        self.options = {"checkpoint": checkpoint, **options}
        self.tried: list[Metrics] = []

    def learn(self, steps: int) -> float:
        """Learn up to a number of steps, and return the mean training loss of the last ones."""
        steps = min(steps, self.config.steps)
        history = fit(self.loss, self.buffer, self.config, until=steps, **self.options)
        self.tried = history[: math.ceil(steps / self.config.iteration)]
        return self.tried[-1][self.loss.out_keys[0]]

    def finish(self, log: Log | None = None) -> list[Metrics]:
        """Learn on to the end, log what was tried first, too, and return all metrics."""
        if log is not None:
            for metrics in self.tried:
                log(metrics, int(metrics["step"]))
        return fit(self.loss, self.buffer, self.config, log=log, **self.options)


def successive_halving(trials: Sequence[Trial], steps: int, halvings: int = 0) -> Trial:
    """Return the trial with the lowest loss (successive halving, Jamieson and Talwalkar 2016).

    All trials learn for ``steps``; the better half then learns on for as many again, ``halvings``
    times. Interrupted trials end in the same choice.
    """
    for times in range(1, halvings + 2):
        if len(trials) == 1:
            break
        shown = progress_bar(trials, desc="trials")
        losses = {trial: trial.learn(times * steps) for trial in shown}
        trials = sorted(losses, key=lambda trial: losses[trial])[: math.ceil(len(losses) / 2)]
    return trials[0]
