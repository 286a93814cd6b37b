"""The reward module, trained on while the policy improves (paper, "Reward Module")."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer

from ifo_grounding.modules import beside
from ifo_grounding.objectives import RewardLoss
from ifo_grounding.training.supervised import Metrics, make_optimizer, update


class Adversary:
    """Trains a reward model on the policy's actions as negatives.

    Args:
        loss: the reward model's loss.
        demonstrations: labelled demonstrations: the positives.
        steps: gradient steps after each iteration of self-examination.
        lr: learning rate.
        batch_size: demonstrations, and the policy's steps, in each gradient step.
        smoothing: how far the targets are from 1 and 0, for the policy is often right.
        grad_clip: largest norm of the gradient.
    """

    def __init__(
        self,
        loss: RewardLoss,
        demonstrations: ReplayBuffer,
        steps: int,
        lr: float,
        batch_size: int = 256,
        smoothing: float = 0.1,
        grad_clip: float = 1.0,
    ) -> None:
        self.loss, self.demonstrations, self.steps = loss, demonstrations, steps
        self.batch_size, self.smoothing, self.grad_clip = batch_size, smoothing, grad_clip
        self.optimizer = make_optimizer(loss.parameters(), lr)

    def __call__(self, batch: TensorDictBase) -> Metrics:
        """Train on the policy's steps [N, T] and return mean metrics, named ``reward/...``."""
        policy_steps = batch.reshape(-1)
        totals: dict[str, float] = {}
        for _ in range(self.steps):
            rows = torch.randint(len(policy_steps), (self.batch_size,))
            shown = beside(self.demonstrations.sample(self.batch_size), self.loss)
            losses = self.loss.adversarial(shown, policy_steps[rows], self.smoothing)
            for key, value in update(losses, self.optimizer, self.grad_clip).items():
                totals[key] = totals.get(key, 0.0) + float(value) / self.steps
        return {f"reward/{key}": value for key, value in totals.items()}

    def state_dict(self) -> dict:
        """Return the state of the reward model and of its optimizer."""
        return {"loss": self.loss.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
