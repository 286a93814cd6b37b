"""Imitating the demonstrations on while the policy practises."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor
from torchrl.data import ReplayBuffer

from ifo_grounding.errors import UserError
from ifo_grounding.modules import beside
from ifo_grounding.objectives import ImitationLoss


@dataclass
class Rehearsal:
    """Adds the imitation loss to every gradient step of self-examination.

    Practice covers the instructions that the instruction module is sure of; the demonstrations
    cover the others too. Without them the policy forgets what it does not practise (Rajeswaran et
    al. 2018, who mix demonstrations into policy gradients). An extension of the paper.
    """

    loss: ImitationLoss
    """Of the policy that practises."""
    buffer: ReplayBuffer
    """Labelled demonstrations."""
    weight: float
    """Of the imitation loss."""
    batch_size: int = 256
    """Labelled steps per gradient step."""

    def __post_init__(self) -> None:
        """Refuse weights and batches that cannot be."""
        if self.weight <= 0 or self.batch_size < 1:
            raise UserError(
                "a rehearsal needs a positive weight and batch_size, got "
                f"{self.weight} and {self.batch_size}"
            )

    def __call__(self) -> Tensor:
        """Return the weighted loss of a batch of demonstrations."""
        batch = beside(self.buffer.sample(self.batch_size), self.loss)
        return self.weight * self.loss(batch)["loss_imitation"]
