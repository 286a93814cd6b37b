"""What both training loops do from one iteration to the next."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

from ifo_grounding.errors import UserError
from ifo_grounding.progress import progress_bar
from ifo_grounding.training.checkpoint import Checkpoint

Metrics = dict[str, float]
Log = Callable[[Metrics, int], None]
SHOWN = ("loss", "accuracy", "learned_return")
"""Beginnings of the names of metrics that a progress bar shows."""


class Loop:
    """Iterations of a training loop, which go on from a checkpoint and end in one.

    There are ``iterations``, also if some are done. At least ``seconds`` pass between two saves.
    """

    def __init__(
        self,
        name: str,
        iterations: int,
        saved: Checkpoint | None,
        seconds: float,
        log: Log | None,
        progress: bool,
    ) -> None:
        self.name, self.iterations, self.saved, self.seconds = name, iterations, saved, seconds
        self.log, self.progress = log, progress
        state = saved.load() if saved else None
        self.history: list[Metrics] = state["history"] if state else []
        self._last_save = time.monotonic()

    def __iter__(self) -> Iterator[int]:
        """Yield the iterations that are still to be done, and show how far they are."""
        first, end = len(self.history), self.iterations
        how = {"total": end, "initial": first, "leave": False}
        with progress_bar(desc=self.name, shown=self.progress, **how) as bar:
            for iteration in range(first, end):
                yield iteration
                metrics = self.history[-1]
                shown = [key for key in metrics if key.startswith(SHOWN)][:3]
                bar.set_postfix({key: f"{metrics[key]:.3f}" for key in shown}, refresh=False)
                bar.update()

    def check(self, metrics: Metrics, step: int) -> None:
        """Refuse what has diverged.

        Raises:
            UserError: where a loss is no longer finite.
        """
        losses = [key for key in metrics if key.startswith("loss_")]
        if lost := [key for key in losses if not math.isfinite(metrics[key])]:
            raise UserError(
                f"{self.name} diverged: {', '.join(lost)} no longer finite by step {step}; learn "
                "with a lower lr"
            )

    def add(self, metrics: Metrics, step: int) -> None:
        """Note the metrics of an iteration, and save if it is time to.

        Raises:
            UserError: as of :meth:`check`.
        """
        self.check(metrics, step)
        self.history.append(metrics)
        if self.log:
            self.log(metrics, step)
        last = len(self.history) >= self.iterations
        if self.saved and (last or time.monotonic() - self._last_save > self.seconds):
            self.saved.save({"history": self.history})
            self._last_save = time.monotonic()
