"""One loop for everything that learns from a replay buffer."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import RandomSampler, ReplayBuffer

from ifo_grounding.errors import UserError, check_choice, check_numbers, check_range
from ifo_grounding.modules import beside, device_of
from ifo_grounding.seeding import derive
from ifo_grounding.training.checkpoint import Checkpoint
from ifo_grounding.training.loop import Log, Loop, Metrics
from ifo_grounding.training.parallel import averaged, averaging, processes, samples
from ifo_grounding.training.selection import BestWeights
from ifo_grounding.training.updates import (
    decay_towards_origin,
    make_optimizer,
    means,
    prepared,
    set_rates,
    update,
)

SCHEDULES = ("constant", "cosine")
WARMUP = 0.1
"""Share of the steps that warm up, with the schedule ``cosine``."""


@dataclass
class FitConfig:
    """How long and how fast to learn."""

    steps: int = 2000
    """Gradient steps."""
    batch_size: int = 512
    """Samples per step."""
    lr: float = 8e-4
    """Peak learning rate (paper: 8e-4)."""
    schedule: str = "cosine"
    """``constant``, or ``cosine``: a short warm-up, then down to zero."""
    weight_decay: float = 0.0
    """Decoupled weight decay; 0 makes AdamW the paper's Adam. Weights decay to zero, or where they
    are another network's (``init_from``) to what they were there (L2-SP, Li et al. 2018), so that
    a network does not forget what the other one has learned."""
    prior: float = 0.0
    """Weight decay is this over the number of samples, where that is more than ``weight_decay``: a
    Gaussian prior on weights, which counts more the fewer samples there are."""
    iteration: int = 50
    """Steps between two points where a killed run can continue."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_choice("schedule", self.schedule, SCHEDULES)
        check_range(self, "steps", "batch_size", "iteration", least=1)
        check_range(self, "lr", above=0)
        check_range(self, "weight_decay", "prior", least=0)

    def rate(self, step: int) -> float:
        """Return the share of the peak learning rate at a step."""
        if self.schedule == "constant":
            return 1.0
        warmup = max(1, round(WARMUP * self.steps))
        if step < warmup:
            return (step + 1) / warmup
        return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, self.steps - warmup)))

    def decay(self, samples: int) -> float:
        """Return the weight decay for a number of samples.

        >>> FitConfig(weight_decay=0.01, prior=2000).decay(1000)
        2.0
        """
        return max(self.weight_decay, self.prior / max(1, samples))


def fit(
    loss: nn.Module,
    buffer: ReplayBuffer,
    config: FitConfig,
    *,
    seed: int,
    name: str = "fit",
    checkpoint: str | Path | None = None,
    checkpoint_seconds: float = 15.0,
    log: Log | None = None,
    held_out: BestWeights | None = None,
    progress: bool = False,
    until: int | None = None,
    cudagraph: bool = False,
) -> list[Metrics]:
    """Minimise a loss module over samples of a replay buffer.

    Processes that ``torchrun`` started and :func:`torch.distributed.init_process_group` joined
    learn together: each computes the gradient of its share of a batch.

    Args:
        loss: a LossModule; entries of its output named ``loss_*`` are minimised, others are
            metrics. Where it has ``set_progress``, it is told the share of steps done.
        buffer: ``sample(batch_size)`` gives the loss its input; ``len`` of it decides how much
            ``config.prior`` counts.
        seed: all randomness is a function of it, of ``name`` and of the iteration.
        name: names the stream of randomness, and the progress bar.
        checkpoint: file to continue from, to the same result, and to save to; not with a buffer
            that prefetches or has a generator of its own.
        log: gets the mean metrics of each iteration and the step.
        held_out: an :class:`~ifo_grounding.training.EarlyStopping` or a
            :class:`~ifo_grounding.training.BestCheckpoint`, whose best weights are kept in the end.
        until: steps after which to pause, rounded up to whole iterations; a later call with the
            same checkpoint goes on. None learns to the end.
        cudagraph: whether to capture the step as a CUDA graph on a GPU, where the loss is
            ``capturable`` and samples are drawn at random; for networks that compute the same
            whatever they see, as those of this library do.

    Returns mean metrics of each iteration, with ``step`` and ``samples_per_second``.

    Raises:
        UserError: where ``buffer`` cannot be sampled, the checkpoint is of something else, or the
            loss is no longer finite.
    """
    if not callable(getattr(buffer, "sample", None)):
        raise UserError(
            f"fit samples from a replay buffer, got {type(buffer).__name__}: demonstrations become "
            "one by labelled_buffer(demos, label_demonstrations(demos, inverse).report.actions)"
        )
    device = device_of(loss) or torch.device("cpu")
    if device.type != "cpu":
        loss.to(device)  # with all that it holds beside its network
    decay = config.decay(len(buffer)) if config.prior else config.weight_decay
    optimizer = make_optimizer(loss.parameters(), config.lr, decay)
    if decay:
        decay_towards_origin(optimizer, loss)
    sampler = getattr(buffer, "sampler", None)
    parts: dict[str, Any] = {"loss": loss, "optimizer": optimizer}
    parts |= {"held_out": held_out} if held_out else {}
    if sampler is not None and not isinstance(sampler, RandomSampler):
        parts["sampler"] = sampler  # where it is in its round
    settings = {**asdict(config), "seed": seed, "name": name}
    iterations = math.ceil(config.steps / config.iteration)
    pause_at = iterations if until is None else min(math.ceil(until / config.iteration), iterations)
    saved = Checkpoint(checkpoint, settings, **parts) if checkpoint else None
    loop = Loop(name, pause_at, saved, checkpoint_seconds, log, progress)
    same_steps = getattr(loss, "capturable", False) and isinstance(sampler, RandomSampler)
    shared = averaging(loss)

    def step(batch: TensorDictBase) -> dict[str, Tensor]:
        return update(shared(batch), optimizer)

    make_step = prepared(step, optimizer, cudagraph and same_steps and processes() == 1)
    for iteration in loop:
        first = iteration * config.iteration
        steps = range(first, min(first + config.iteration, config.steps))
        updates: list[dict[str, Tensor]] = []
        start = time.perf_counter()
        drawn = samples(buffer, config.batch_size, len(steps), derive(seed, name, iteration))
        for number, batch in zip(steps, drawn, strict=True):
            if callable(set_progress := getattr(loss, "set_progress", None)):
                set_progress(number / config.steps)
            set_rates(optimizer, config.lr * config.rate(number))
            updates.append(make_step(beside(batch, loss)))
        found = averaged(means(updates), device)  # a GPU is waited for once, not after each step
        speed = len(steps) * config.batch_size / (time.perf_counter() - start)
        metrics = {"step": float(steps.stop), **found, "samples_per_second": speed}
        done = iteration + 1
        if held_out:
            if done % held_out.every == 0 or done == iterations:
                metrics |= held_out.measure()
            if done == iterations:
                held_out.restore()
        loop.add(metrics, steps.stop)
    return loop.history
