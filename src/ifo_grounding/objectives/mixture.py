"""How many of the unlabelled are positive: the share of false negatives, estimated."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

SLACK = 0.01
FAILURE = 0.1
"""Probability with which the bound may fail."""


def best_bin_estimate(positive: Tensor, unlabelled: Tensor) -> float:
    """Estimate the share of positives [P] among unlabelled samples [U] from a classifier's scores.

    Above a threshold that hardly any true negative passes, the unlabelled are as frequent as the
    positives times the share. The threshold is the one with the least upper confidence bound
    (Garg et al., "Mixture Proportion Estimation and PU Learning: A Modern Approach", 2021).

    >>> positive = torch.linspace(1, 2, 5000)
    >>> negative = torch.linspace(-2, -1, 9000)
    >>> round(best_bin_estimate(positive, torch.cat([positive[::5], negative])), 2)
    0.1
    """
    thresholds = positive.sort(descending=True).values
    n_positive, n_unlabelled = len(positive), len(unlabelled)
    above = torch.arange(1, n_positive + 1, device=positive.device) / n_positive
    ordered = unlabelled.sort().values
    passed = (n_unlabelled - torch.searchsorted(ordered, thresholds)) / n_unlabelled
    width = math.sqrt(math.log(4 / FAILURE) / 2) * (n_positive**-0.5 + n_unlabelled**-0.5)
    best = ((passed + (1 + SLACK) * width) / above).argmin()
    return float((passed[best] / above[best]).clamp(0, 1))


class MixtureEstimate(nn.Module):
    """Remembers recent scores of positives and unlabelled samples, and estimates from them.

    Args:
        size: scores of positives to remember.
        ratio: how many unlabelled ones to remember for each of them.

    >>> estimate = MixtureEstimate(size=100, ratio=1)
    >>> estimate.add(torch.ones(60), torch.cat([torch.ones(30), -torch.ones(30)]))
    >>> estimate.share()
    0.5
    """

    positive: Tensor
    unlabelled: Tensor
    count: Tensor

    def __init__(self, size: int = 4096, ratio: int = 8) -> None:
        super().__init__()
        self.ratio = ratio
        self.register_buffer("positive", torch.zeros(size))
        self.register_buffer("unlabelled", torch.zeros(size * ratio))
        self.register_buffer("count", torch.zeros(2, dtype=torch.int64))

    @torch.no_grad()
    def add(self, positive: Tensor, unlabelled: Tensor) -> None:
        """Remember scores, [N] and [M]; the oldest are forgotten."""
        both = [(self.positive, positive), (self.unlabelled, unlabelled)]
        for kind, (memory, scores) in enumerate(both):
            scores = scores.detach().flatten().to(memory.dtype)[-len(memory) :]
            places = torch.arange(len(scores), device=memory.device) + self.count[kind]
            memory[places % len(memory)] = scores
            self.count[kind] += len(scores)

    def share(self) -> float:
        """Estimate the share of positives among the unlabelled; 0 before there are any scores."""
        positive, unlabelled = (
            memory[: int(count)]
            for memory, count in zip((self.positive, self.unlabelled), self.count, strict=True)
        )
        return best_bin_estimate(positive, unlabelled) if len(positive) else 0.0
