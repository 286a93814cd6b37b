"""One loop for everything that learns from a replay buffer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import RandomSampler, ReplayBuffer

from ifo_grounding.errors import UserError, at_least_one, check_numbers
from ifo_grounding.modules import beside, device_of
from ifo_grounding.networks.warm_start import inherited
from ifo_grounding.seeding import derive
from ifo_grounding.training.captured import CapturedUpdate, Update, let_capture, set_rate
from ifo_grounding.training.checkpoint import Checkpoint, fingerprint

Metrics = dict[str, float]
Callback = Callable[[int], Metrics]
Log = Callable[[Metrics, int], None]


class Validation(Protocol):
    """Measures a network on something else than its loss, and remembers the best weights."""

    metric: str

    def look(self) -> float: ...  # noqa: D102

    def restore(self) -> None: ...  # noqa: D102

    def state_dict(self) -> dict[str, Any]: ...  # noqa: D102

    def load_state_dict(self, state: dict[str, Any]) -> Any: ...  # noqa: D102


@dataclass(frozen=True)
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
    warmup: float = 0.1
    """Share of the steps that warm up, with ``cosine``."""
    weight_decay: float = 0.0
    """Decoupled weight decay; 0 makes AdamW the paper's Adam. Weights decay to zero, or where they
    are another network's (``init_from``) to what they were there (L2-SP, Li et al. 2018): what one
    has learned is not for the other to forget."""
    prior: float = 0.0
    """Weight decay is this over the number of samples, where that is more than ``weight_decay``: a
    Gaussian prior on weights, which counts for the more the less there is to learn from."""
    grad_clip: float = 1.0
    """Largest norm of the gradient."""
    iteration: int = 50
    """Steps between two points where a killed run can continue."""
    evaluate_every: int = 0
    """Iterations between two calls of the callback; 0 calls it at the end only."""
    validate_every: int = 4
    """Iterations between two looks at the held-out loss, where there is one."""

    def __post_init__(self) -> None:
        """Refuse sizes that cannot be."""
        check_numbers(self, unbounded=["grad_clip"])
        for name in ("steps", "batch_size", "iteration", "validate_every"):
            at_least_one(name, getattr(self, name))
        for name in ("lr", "grad_clip"):
            if not getattr(self, name) > 0:
                raise UserError(f"{name} must be above 0, got {getattr(self, name)}")
        for name in ("weight_decay", "prior", "evaluate_every"):
            if not getattr(self, name) >= 0:
                raise UserError(f"{name} must not be negative, got {getattr(self, name)}")
        if not 0 <= self.warmup <= 1:
            raise UserError(f"warmup is a share of the steps, within 0..1, got {self.warmup}")
        if self.schedule not in ("constant", "cosine"):
            raise UserError(f"unknown schedule {self.schedule!r}: choose constant or cosine")

    def rate(self, step: int) -> float:
        """Return the share of the peak learning rate at a step."""
        if self.schedule == "constant":
            return 1.0
        warmup = max(1, round(self.warmup * self.steps))
        if step < warmup:
            return (step + 1) / warmup
        return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, self.steps - warmup)))

    def decay(self, samples: int) -> float:
        """Return the weight decay for a number of samples.

        >>> FitConfig(weight_decay=0.01, prior=2000).decay(1000)
        2.0
        """
        return max(self.weight_decay, self.prior / max(1, samples))


def make_optimizer(
    parameters: Iterable[nn.Parameter], lr: float, weight_decay: float = 0.0
) -> torch.optim.Optimizer:
    """Return AdamW in its fused form."""
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    return torch.optim.AdamW(trained, lr=lr, weight_decay=weight_decay, fused=True)


def decay_towards_origin(optimizer: torch.optim.Optimizer, module: nn.Module) -> None:
    """Let the weights that a module has inherited decay towards what they were, not to zero."""
    begun = [(weight, start) for weight, start in inherited(module) if weight.requires_grad]

    @torch.no_grad()
    def undo(optimizer: torch.optim.Optimizer, *_: Any) -> None:
        group = optimizer.param_groups[0]
        for weight, start in begun:
            weight.add_(start, alpha=group["lr"] * group["weight_decay"])

    optimizer.register_step_post_hook(undo)


def total_loss(losses: TensorDictBase) -> Tensor:
    """Add up all entries named ``loss_*``."""
    return torch.stack(
        [value.mean() for key, value in losses.items() if str(key).startswith("loss_")]
    ).sum()


def update(
    losses: TensorDictBase, optimizer: torch.optim.Optimizer, grad_clip: float
) -> dict[str, Tensor]:
    """Make one gradient step and return what the losses and metrics were."""
    optimizer.zero_grad(set_to_none=True)
    total_loss(losses).backward()
    trained = [p for group in optimizer.param_groups for p in group["params"]]
    norm = nn.utils.clip_grad_norm_(trained, grad_clip)
    optimizer.step()
    scalars = {str(key): value.detach().float().mean() for key, value in losses.items()}
    return {**scalars, "grad_norm": norm.detach()}


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
    callback: Callback | None = None,
    held_out: Validation | None = None,
    progress: bool = False,
    settings: Any = None,
    until: int | None = None,
    cudagraph: bool = False,
) -> list[Metrics]:
    """Minimise a loss module over samples of a replay buffer.

    Args:
        loss: a LossModule; entries of its output named ``loss_*`` are minimised, others are
            metrics. Where it has ``set_progress``, it is told the share of steps done.
        buffer: ``sample(batch_size)`` gives the loss its input; ``len`` of it decides how much
            ``config.prior`` counts.
        config: steps, batch size, learning rate.
        seed: all randomness is a function of it, of ``name`` and of the iteration, but for that of
            generators given to the loss or the buffer, which a checkpoint keeps. A buffer that
            prefetches draws ahead of its time: its runs do not continue to the same result.
        name: names the stream of randomness, and the progress bar.
        checkpoint: file to continue from and to save to.
        checkpoint_seconds: least time between two checkpoints.
        log: gets the mean metrics of each iteration and the step.
        callback: gets the step, returns further metrics.
        held_out: measures the loss on held-out samples (``held_out_loss``), or the learned return
            (``selection_return``); the weights that did best there are kept in the end.
        progress: whether to show a progress bar.
        settings: what else decides the result; a checkpoint made with other settings is refused.
        until: steps after which to pause, rounded up to whole iterations; a later call with the
            same checkpoint goes on. None learns to the end.
        cudagraph: whether a GPU may be told of a step once and repeat it, where the loss is
            ``capturable``, weights do not decay and samples are drawn at random; for networks that
            compute the same whatever they see, as those of this library do.

    Returns:
        Mean metrics of each iteration, with ``step`` and ``samples_per_second``.

    Raises:
        UserError: where ``buffer`` cannot be sampled, the checkpoint is of something else, or the
            loss is no longer finite.
    """
    if not callable(getattr(buffer, "sample", None)):
        raise UserError(
            f"fit samples from a replay buffer, got {type(buffer).__name__}: demonstrations become "
            "one by labelled_buffer(demos, label_demonstrations(demos, inverse).actions)"
        )
    device = device_of(loss) or torch.device("cpu")
    if device.type != "cpu":
        loss.to(device)  # with all that it holds beside its network
    decay = config.decay(len(buffer)) if config.prior else config.weight_decay
    optimizer = make_optimizer(loss.parameters(), config.lr, decay)
    if decay:
        decay_towards_origin(optimizer, loss)
    saved = None
    sampler = getattr(buffer, "sampler", None)
    if checkpoint:
        parts: dict[str, Any] = {"loss": loss, "optimizer": optimizer}
        parts |= {"held_out": held_out} if held_out else {}
        if sampler is not None and not isinstance(sampler, RandomSampler):
            parts["sampler"] = sampler  # where it is in its round
        saved = Checkpoint(checkpoint, fingerprint(config, seed, name, settings), **parts)
    state = (saved.load() if saved else None) or {"iteration": 0, "history": []}
    same_steps = getattr(loss, "capturable", False) and not decay
    same_sizes = isinstance(sampler, RandomSampler)
    captured = cudagraph and device.type == "cuda" and same_steps and same_sizes
    let_capture(optimizer, captured)

    def step(batch: TensorDictBase) -> dict[str, Tensor]:
        return update(loss(batch), optimizer, config.grad_clip)

    make_step: Update = CapturedUpdate(step) if captured else step
    generators = generators_of(loss, buffer)
    for generator, drawn in zip(generators, state.get("generators", []), strict=False):
        generator.set_state(drawn)
    history: list[Metrics] = state["history"]
    iterations = math.ceil(config.steps / config.iteration)
    last_save = time.monotonic()
    pause_at = iterations if until is None else min(math.ceil(until / config.iteration), iterations)
    with _bar(pause_at, state["iteration"], name, progress) as bar:
        for iteration in range(state["iteration"], pause_at):
            torch.manual_seed(derive(seed, name, iteration))
            first = iteration * config.iteration
            steps = range(first, min(first + config.iteration, config.steps))
            metrics = _iterate(loss, buffer, optimizer, config, steps, make_step)
            done = iteration + 1
            losses = [key for key in metrics if key.startswith("loss_")]
            if lost := [key for key in losses if not math.isfinite(metrics[key])]:
                raise UserError(
                    f"{name} diverged: {', '.join(lost)} no longer finite by step {steps.stop}; "
                    "learn with a lower lr"
                )
            if held_out:
                if done % config.validate_every == 0 or done == iterations:
                    metrics[held_out.metric] = held_out.look()
                if done == iterations:
                    held_out.restore()
            due = config.evaluate_every and done % config.evaluate_every == 0
            if callback and (due or done == iterations):
                metrics |= plain_numbers(callback(steps.stop))
            history.append(metrics)
            if log:
                log(metrics, steps.stop)
            bar.set_postfix(_brief(metrics), refresh=False)
            bar.update()
            pause = time.monotonic() - last_save
            if saved and (pause > checkpoint_seconds or done == pause_at):
                drawn = {"generators": [each.get_state() for each in generators]}
                saved.save({"iteration": done, "history": history, **(drawn if generators else {})})
                last_save = time.monotonic()
    return history


def plain_numbers(metrics: Metrics) -> Metrics:
    """Return metrics as Python's numbers, which a checkpoint can hold."""
    return {name: float(value) for name, value in metrics.items()}


def generators_of(loss: nn.Module, buffer: Any) -> list[torch.Generator]:
    """Return the generators that a loss and a buffer draw from instead of the global one."""
    holders = [*loss.modules(), getattr(buffer, "sampler", None)]
    held = [getattr(one, name, None) for one in holders for name in ("generator", "_rng")]
    return list(dict.fromkeys(one for one in held if isinstance(one, torch.Generator)))


def _iterate(
    loss: nn.Module,
    buffer: ReplayBuffer,
    optimizer: torch.optim.Optimizer,
    config: FitConfig,
    steps: range,
    make_step: Update,
) -> Metrics:
    sums: dict[str, Tensor] = {}
    start = time.perf_counter()
    for step in steps:
        if callable(set_progress := getattr(loss, "set_progress", None)):
            set_progress(step / config.steps)
        set_rate(optimizer, config.lr * config.rate(step))
        batch = beside(buffer.sample(config.batch_size), loss)
        for key, value in make_step(batch).items():  # summed where it lies: a GPU is not waited for
            sums[key] = sums[key] + value if key in sums else value.clone()
    means = {key: float(value) / len(steps) for key, value in sums.items()}
    speed = len(steps) * config.batch_size / (time.perf_counter() - start)
    return {"step": float(steps.stop), **means, "samples_per_second": speed}


def _bar(total: int, initial: int, name: str, progress: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, initial=initial, desc=name, disable=not progress, leave=False)


def _brief(metrics: Metrics) -> dict[str, str]:
    shown = [key for key in metrics if key.startswith(("loss", "accuracy", "success"))]
    return {key.removeprefix("loss_"): f"{metrics[key]:.3f}" for key in shown[:3]}
