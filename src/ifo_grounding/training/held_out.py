"""Keeping the weights with the lowest loss on data that is not trained on."""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from torch import nn
from torchrl.data import ReplayBuffer

from ifo_grounding.errors import UserError
from ifo_grounding.modules import beside
from ifo_grounding.objectives import mode
from ifo_grounding.training.supervised import generators_of, total_loss


class HeldOut:
    """Measures a loss on held-out samples and remembers the weights that did best.

    Pass it to :func:`~ifo_grounding.training.fit`, which asks it every few iterations and brings
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
    >>> held_out = HeldOut(loss, first_frame_buffer(demos))
    >>> held_out.look() == held_out.best_loss
    True
    """

    metric = "held_out_loss"

    def __init__(self, loss: nn.Module, buffer: ReplayBuffer, batch_size: int = 1024) -> None:
        if not len(buffer):
            raise UserError("there are no held-out samples: hold a larger share out")
        self.loss, self.buffer, self.batch_size = loss, buffer, batch_size
        self.best_loss = math.inf
        self.best_weights: dict[str, torch.Tensor] = {}

    @torch.no_grad()
    def look(self) -> float:
        """Measure the loss, and remember the weights if it is the lowest so far."""
        generators = generators_of(self.loss, self.buffer)
        drawn = [generator.get_state() for generator in generators]
        with mode(self.loss, training=False), torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # the same negatives at every look
            for generator in generators:
                generator.manual_seed(0)
            total = 0.0
            for rows in torch.arange(len(self.buffer)).split(self.batch_size):
                total += float(total_loss(self.loss(beside(self.buffer[rows], self.loss)))) * len(
                    rows
                )
        for generator, state in zip(generators, drawn, strict=True):
            generator.set_state(state)
        mean = total / len(self.buffer)
        if mean < self.best_loss:
            self.best_loss = mean
            self.best_weights = copy.deepcopy(self.loss.state_dict())
        return mean

    def restore(self) -> None:
        """Bring back the weights that did best."""
        if self.best_weights:
            self.loss.load_state_dict(self.best_weights)

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint has to keep."""
        return {"best_loss": self.best_loss, "best_weights": self.best_weights}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.best_loss, self.best_weights = state["best_loss"], state["best_weights"]
