"""Early stopping: keeping the weights with the lowest loss on samples that are not trained on."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from ifo_grounding.errors import UserError
from ifo_grounding.modules import beside, evaluating
from ifo_grounding.training.updates import total_loss


class BestWeights:
    """The weights of a module that did best so far, by whatever a subclass measures.

    Args:
        module: whose weights are remembered.
    """

    metric: str
    """Name of what :meth:`measure` returns."""

    def __init__(self, module: nn.Module) -> None:
        self.module = module
        self.best: Tensor | None = None
        self.weights: dict[str, Tensor] = {}

    def measure(self) -> float:
        """Measure the module, and remember its weights if they do better than those before."""
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

    Pass it to :func:`~ifo_grounding.training.fit`, which measures every few iterations and brings
    the best weights back in the end: early stopping without a patience to choose.

    Args:
        loss: the LossModule that is trained; it is measured in eval mode.
        buffer: held-out samples, all of which are measured.
        batch_size: samples measured together.

    Raises:
        UserError: where the buffer is empty.

    >>> from ifo_grounding.data import Demonstrations, first_frame_buffer
    >>> from ifo_grounding.networks import make_instruction_classifier
    >>> from ifo_grounding.objectives import InstructionLoss
    >>> frames = [torch.zeros(3, 3, 48, 48, dtype=torch.uint8) for _ in range(8)]
    >>> demos = Demonstrations.from_arrays(frames, ["go up", "go down"] * 4)
    >>> loss = InstructionLoss(make_instruction_classifier(demos, seed=0), demos.pool())
    >>> early_stopping = EarlyStopping(loss, first_frame_buffer(demos))
    >>> early_stopping.measure() == early_stopping.best.item()
    True
    """

    metric = "held_out_loss"

    def __init__(self, loss: nn.Module, buffer: ReplayBuffer, batch_size: int = 1024) -> None:
        if not len(buffer):
            raise UserError("there are no held-out samples: hold a larger share out")
        super().__init__(loss)
        self.buffer, self.batch_size = buffer, batch_size

    def measure(self) -> float:
        """Return the loss on all samples, and remember the weights if it is the lowest so far."""
        total = 0.0
        with evaluating(self.module), torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # the same negatives every time
            for rows in torch.arange(len(self.buffer)).split(self.batch_size):
                losses = self.module(beside(self.buffer[rows], self.module))
                total += float(total_loss(losses)) * len(rows)
        mean = total / len(self.buffer)
        if self.best is None or mean < self.best:
            self.remember(torch.tensor(mean, dtype=torch.float64))
        return mean
