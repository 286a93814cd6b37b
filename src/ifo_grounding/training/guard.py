"""Noticing a reward that leads astray, by demonstrations that the policy has not learned from."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ifo_grounding import keys
from ifo_grounding.data.buffers import FINAL
from ifo_grounding.errors import UserError
from ifo_grounding.modules import beside, evaluating


class Guard:
    """Asks whether a policy still does what demonstrations do that it never learned from.

    Its weights may have been chosen by them, where imitation stopped by their likelihood, and the
    judges learn from all demonstrations: what it reports is a warning, no estimate of success.

    A learned reward may take the policy's own mistakes for success. Practice then makes them more
    frequent while the learned return rises, and no look at that return can tell. Held-out
    demonstrations, with the actions that the inverse module gave them, can: a policy that goes
    astray agrees with them less often than the first one that was looked at. Which of two shortest
    paths a demonstrator happened to take differs by chance, and in favour of neither policy.

    Args:
        policy: acts greedily.
        buffer: held-out transitions, as :func:`~ifo_grounding.data.labelled_buffer` makes them.
        margin: standard errors of the paired difference, over demonstrations, by which a policy
            has to fall behind.
        batch_size: transitions looked at together.

    Raises:
        UserError: where the buffer is empty.
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

    @torch.no_grad()
    def agreement(self) -> Tensor:
        """Return how much of each held-out demonstration the policy would do, float32 [D]."""
        right, final = [], []
        with evaluating(self.policy), set_exploration_type(ExplorationType.DETERMINISTIC):
            for rows in torch.arange(len(self.buffer)).split(self.batch_size):
                seen = beside(self.buffer[rows], self.policy)
                wanted = seen.pop(keys.ACTION)
                right.append((self.policy(seen)[keys.ACTION] == wanted).float().cpu())
                final.append(seen[FINAL].squeeze(-1).long().cpu())
        ended = torch.cat(final)
        of = ended.cumsum(0) - ended
        total = torch.zeros(2, int(of[-1]) + 1).index_add_(
            1, of, torch.stack([torch.cat(right), torch.ones(len(of))])
        )
        return total[0] / total[1]

    def look(self) -> tuple[float, bool]:
        """Return the mean agreement, and whether it has fallen behind that of the first look."""
        agreement = self.agreement()
        if self.first is None:
            self.first = agreement
        change = agreement - self.first
        error = float(change.std()) / math.sqrt(len(change)) if len(change) > 1 else math.inf
        return float(agreement.mean()), float(change.mean()) < -self.margin * error

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint has to keep."""
        return {"first": self.first}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint."""
        self.first = state["first"]
