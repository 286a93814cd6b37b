"""Captures a gradient step as a CUDA graph, which a GPU repeats without waiting for Python."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ifo_grounding.errors import UserError

Update = Callable[[TensorDictBase], dict[str, Tensor]]
WARM_UP = 3
"""Steps before the capture, kernel by kernel, in which libraries choose their algorithms."""


class CapturedUpdate:
    """Makes the same update of batch after batch, from the fourth on as one CUDA graph.

    A small network's step is hundreds of kernels of some microseconds each, and Python launches
    them more slowly than a GPU computes them. ``tensordict.nn.CudaGraphModule`` captures a step
    too, but synchronises with the GPU at every call.

    Args:
        update: maps a batch to metrics. It launches the same kernels whatever the batch holds,
            reads no tensor back to the CPU, and steps an optimizer prepared by
            :func:`let_capture`.

    The next call overwrites the metrics that a call returned.

    Raises:
        UserError: where the update cannot be captured.
    """

    def __init__(self, update: Update) -> None:
        self.update = update
        self.made = 0
        self.graph: torch.cuda.CUDAGraph | None = None
        self.batch: TensorDictBase
        self.metrics: dict[str, Tensor]

    def __call__(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Make the update of a batch, whose tensors have the shapes of the first one's."""
        self.made += 1
        if self.made <= WARM_UP:
            return self._aside(batch)
        if self.graph is None:
            self.batch, self.graph = batch.clone(), torch.cuda.CUDAGraph()
            try:
                with torch.cuda.graph(self.graph):
                    self.metrics = self.update(self.batch)
            except RuntimeError as error:
                raise UserError(
                    f"this step cannot be one CUDA graph ({str(error).splitlines()[0]}): its "
                    "network reads something back, or computes other shapes for other batches; "
                    "pass cudagraph=False"
                ) from error
        else:
            self.batch.update_(batch)
        self.graph.replay()
        return self.metrics

    def _aside(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Make the update on a stream of its own, as what is captured later has to be."""
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            metrics = self.update(batch)
        torch.cuda.current_stream().wait_stream(aside)
        return metrics


def let_capture(optimizer: torch.optim.Optimizer, captured: bool) -> None:
    """Prepare an optimizer for a CUDA graph, or for none, whatever a checkpoint has set."""
    for group in optimizer.param_groups:
        rate = float(group["lr"])
        group["lr"] = torch.tensor(rate, device=group["params"][0].device) if captured else rate
        group["capturable"] = captured


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate, in place where a graph reads it."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate
