"""One gradient step, and its capture as a CUDA graph, which a GPU repeats without Python."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from ifo_grounding.errors import UserError, first_line
from ifo_grounding.networks.warm_start import inherited

Update = Callable[[TensorDictBase], dict[str, Tensor]]
WARM_UP = 3
"""Steps before the capture, kernel by kernel, in which libraries choose their algorithms."""


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
        share = group["lr"] * group["weight_decay"]
        for weight, start in begun:
            if isinstance(share, Tensor):  # a graph reads it
                weight.addcmul_(start, share)
            else:
                weight.add_(start, alpha=share)

    optimizer.register_step_post_hook(undo)


def total_loss(losses: TensorDictBase) -> Tensor:
    """Add up all entries named ``loss_*``, of which there has to be one."""
    found: Any = getattr(losses, "items", dict)()
    named = [value.mean() for key, value in found if str(key).startswith("loss_")]
    if not named:
        raise UserError(
            "a loss must return a TensorDict with entries named loss_*, got "
            f'{type(losses).__name__} without: return TensorDict({{"loss_mine": loss}})'
        )
    return torch.stack(named).sum()


def update(
    losses: TensorDictBase, optimizer: torch.optim.Optimizer, grad_clip: float = 1.0
) -> dict[str, Tensor]:
    """Make one gradient step, of this norm at most; return what losses and metrics were."""
    optimizer.zero_grad(set_to_none=True)
    total_loss(losses).backward()
    trained = [p for group in optimizer.param_groups for p in group["params"]]
    norm = nn.utils.clip_grad_norm_(trained, grad_clip)
    optimizer.step()
    scalars = {str(key): value.detach().float().mean() for key, value in losses.items()}
    return {**scalars, "grad_norm": norm.detach()}


def means(updates: list[dict[str, Tensor]]) -> dict[str, float]:
    """Return the mean of each metric over those of some updates that have it."""
    names = dict.fromkeys(name for each in updates for name in each)
    found = {name: [each[name] for each in updates if name in each] for name in names}
    return {name: float(torch.stack(values).mean()) for name, values in found.items()}


class CapturedUpdate:
    """Makes the same update of batch after batch, from the fourth on as one CUDA graph.

    Python launches the hundreds of kernels of a small network's step more slowly than a GPU
    computes them. ``tensordict.nn.CudaGraphModule`` synchronises with the GPU at every call.

    An update that cannot be captured goes on kernel by kernel, after a warning.

    Args:
        update: maps a batch to metrics, by the same kernels whatever the batch holds, reads nothing
            back to the CPU, and steps an optimizer prepared by :func:`let_capture`.
    """

    def __init__(self, update: Update) -> None:
        self.update = update
        self.made = 0
        self.suits = True
        self.graph: torch.cuda.CUDAGraph | None = None
        self.batch: TensorDictBase
        self.metrics: dict[str, Tensor]

    def __call__(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Make the update of a batch, whose tensors have the shapes of the first one's."""
        self.made += 1
        if self.made <= WARM_UP:
            return self._aside(batch)
        if not self.suits:
            return self.update(batch)
        if self.graph is None:
            kept, graph = batch.clone(), torch.cuda.CUDAGraph()
            try:
                with torch.cuda.graph(graph):
                    metrics = self.update(kept)
            except RuntimeError as error:
                self.suits = False
                warnings.warn(
                    f"a step cannot be one CUDA graph ({first_line(error)}) and takes longer: its "
                    "network reads something back, or computes other shapes for other batches",
                    stacklevel=2,
                )
                return self.update(batch)
            self.batch, self.graph, self.metrics = kept, graph, metrics
        else:
            self.batch.update_(batch)
        self.graph.replay()
        return {key: value.clone() for key, value in self.metrics.items()}

    def _aside(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Make the update on a stream of its own, as what is captured later has to be."""
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            metrics = self.update(batch)
        torch.cuda.current_stream().wait_stream(aside)
        return metrics


def prepared(step: Update, optimizer: torch.optim.Optimizer, cudagraph: bool) -> Update:
    """Return a step that steps an optimizer, on a GPU as a CUDA graph if that is wanted."""
    captured = cudagraph and optimizer.param_groups[0]["params"][0].is_cuda
    let_capture(optimizer, captured)
    return CapturedUpdate(step) if captured else step


def let_capture(optimizer: torch.optim.Optimizer, captured: bool) -> None:
    """Prepare an optimizer for a CUDA graph, or for none, whatever a checkpoint has set."""
    for group in optimizer.param_groups:
        rate = float(group["lr"])
        group["lr"] = torch.tensor(rate, device=group["params"][0].device) if captured else rate
        group["capturable"] = captured


def set_rates(optimizer: torch.optim.Optimizer, *rates: float) -> None:
    """Set the learning rate of each group, in place where a graph reads it."""
    for group, rate in zip(optimizer.param_groups, rates, strict=True):
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate
