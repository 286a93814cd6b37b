"""What self-examination may learn from demonstrations beside its policy gradient."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer

from ifo_grounding.errors import check_range
from ifo_grounding.modules import beside
from ifo_grounding.objectives import ImitationLoss, SupervisedLoss
from ifo_grounding.training.loop import Metrics
from ifo_grounding.training.updates import decay_towards_origin, make_optimizer, means, update


@dataclass
class AuxiliaryImitation:
    """Adds the imitation loss to every gradient step of the policy.

    Demonstrations cover also the instructions that the instruction classifier is not sure of, which
    the policy would forget (Rajeswaran et al. 2018). An extension of the paper.
    """

    loss: ImitationLoss
    """Imitation loss of the policy that is improved."""
    buffer: ReplayBuffer
    """Labelled demonstrations."""
    weight: float
    """Weight of the imitation loss, above 0."""
    batch_size: int = 256
    """Labelled steps per gradient step."""

    def __post_init__(self) -> None:
        check_range(self, "weight", above=0)
        check_range(self, "batch_size", least=1)

    def sample(self) -> TensorDictBase:
        """Return a batch of demonstrated steps, where the policy is."""
        return beside(self.buffer.sample(self.batch_size), self.loss)

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """Return the weighted loss of a batch of demonstrated steps, a scalar."""
        return self.weight * self.loss(batch)["loss_imitation"]


class AdversarialUpdates:
    """Trains the reward model on while the policy improves (paper, "Reward Module").

    Demonstrated actions are positives, the policy's own actions are negatives.

    Args:
        loss: its ``adversarial(demonstrated, own)`` is minimised, as of
            :class:`~ifo_grounding.objectives.RewardLoss`.
        steps: gradient steps after each iteration of self-examination.
        batch_size: demonstrated steps, and as many of the policy's, in each gradient step.
        weight_decay: decoupled; inherited weights decay towards what they were.
    """

    loss: Any

    def __init__(
        self,
        loss: SupervisedLoss,
        demonstrations: ReplayBuffer,
        steps: int,
        lr: float,
        batch_size: int = 256,
        weight_decay: float = 0.0,
    ) -> None:
        self.loss, self.demonstrations = loss, demonstrations
        self.steps, self.batch_size = steps, batch_size
        self.optimizer = make_optimizer(loss.parameters(), lr, weight_decay)
        if weight_decay:
            decay_towards_origin(self.optimizer, loss)

    def __call__(self, batch: TensorDictBase) -> Metrics:
        """Train on the policy's steps [N, T] and return mean metrics, named ``reward/...``."""
        policy_steps, updates = batch.reshape(-1), []
        for _ in range(self.steps):
            rows = torch.randint(len(policy_steps), (self.batch_size,))
            shown = beside(self.demonstrations.sample(self.batch_size), self.loss)
            losses = self.loss.adversarial(shown, policy_steps[rows])
            updates.append(update(losses, self.optimizer))
        return {f"reward/{key}": value for key, value in means(updates).items()}
