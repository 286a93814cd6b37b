"""Accuracy of a policy on demonstrations that it has not learned from."""

from __future__ import annotations

import math

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ifo_grounding import keys
from ifo_grounding.data.buffers import FINAL
from ifo_grounding.errors import UserError
from ifo_grounding.modules import beside, evaluating


class HeldOutAccuracy:
    """Compares the greedy actions of a policy with the labels of held-out demonstrations.

    A learned reward may take the policy's own mistakes for success. Self-examination then makes
    them more frequent while the learned return rises, and no measure of that return can tell.
    Held-out demonstrations, with the actions that the inverse model gave them, can: the accuracy of
    such a policy falls below what it was at first. Which of two shortest paths a demonstrator
    happened to take differs by chance, and in favour of neither policy.

    It is a warning, no estimate of success: early stopping may have chosen the policy's weights by
    the same demonstrations, and the learned rewards are trained on all of them.

    Args:
        policy: acts greedily.
        buffer: held-out transitions, as :func:`~ifo_grounding.data.labelled_buffer` makes them.
        margin: standard errors of the paired difference, over demonstrations, by which the
            accuracy has to fall to be clearly worse.
        batch_size: transitions that pass the policy together.

    Raises:
        UserError: where the buffer is empty.

    >>> from ifo_grounding.data import labelled_buffer, record_demonstrations
    >>> from ifo_grounding.networks import make_policy
    >>> demos, truth = record_demonstrations("move", 4, seed=0, keep_truth=True)
    >>> accuracy = HeldOutAccuracy(make_policy(demos), labelled_buffer(demos, truth.actions))
    >>> accuracy.measure().shape
    torch.Size([4])
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        buffer: ReplayBuffer,
        margin: float = 2.0,
        batch_size: int = 1024,
    ) -> None:
        if not len(buffer):
            raise UserError("there are no held-out samples: hold a larger share out")
        self.policy, self.buffer = policy, buffer
        self.margin, self.batch_size = margin, batch_size
        self.first: Tensor | None = None

    def measure(self) -> Tensor:
        """Return the share of each demonstration's actions that the policy takes, float32 [D]."""
        right, final = [], []
        with evaluating(self.policy), set_exploration_type(ExplorationType.DETERMINISTIC):
            for rows in torch.arange(len(self.buffer)).split(self.batch_size):
                seen = beside(self.buffer[rows], self.policy)
                label = seen.pop(keys.ACTION)
                right.append((self.policy(seen)[keys.ACTION] == label).float().cpu())
                final.append(seen[FINAL].squeeze(-1).long().cpu())
        ended = torch.cat(final)
        demonstration = ended.cumsum(0) - ended
        counted = torch.stack([torch.cat(right), torch.ones(len(ended))])
        total = torch.zeros(2, int(demonstration[-1]) + 1).index_add_(1, demonstration, counted)
        return total[0] / total[1]

    def compare(self) -> tuple[float, bool]:
        """Return the mean accuracy, and whether it is clearly below that of the first call."""
        accuracy = self.measure()
        if self.first is None:
            self.first = accuracy
        change = accuracy - self.first
        error = float(change.std()) / math.sqrt(len(change)) if len(change) > 1 else math.inf
        return float(accuracy.mean()), float(change.mean()) < -self.margin * error
