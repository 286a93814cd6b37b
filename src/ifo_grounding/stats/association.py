"""How well a score tells positives from negatives: the area under the ROC curve."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import scipy  # whose parts are loaded where they are used: `scipy.stats` alone takes a second
from numpy.typing import ArrayLike

from ifo_grounding.errors import UserError
from ifo_grounding.stats.results import CONFIDENCE, Estimate

Z = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
"""Standard errors on either side of an estimate that a normal interval covers."""


def auc(scores: ArrayLike, positive: ArrayLike, groups: ArrayLike | None = None) -> Estimate:
    """Return the probability that a positive scores above a negative, ties counting half.

    The interval is Newcombe's (2006, method 5), which inverts the variance of Hanley and McNeil.
    Where groups are given (scores from one demonstration belong together) it is that of as many
    scores as there are groups.

    Args:
        scores: high where positive, [N].
        positive: which are positives, bool [N]; the others are negatives.
        groups: which group each score belongs to, integer [N]; by default each is its own.

    Raises:
        UserError: where the shapes differ, or a score is not finite.

    >>> auc([2.0, 3.0, 1.0, 2.0], [1, 1, 0, 0]).value
    0.875
    """
    every, of = np.asarray(scores, np.float64).ravel(), np.asarray(positive, bool).ravel()
    group = np.arange(len(every)) if groups is None else np.asarray(groups).ravel()
    if not len(every) == len(of) == len(group):
        raise UserError(
            f"{len(every)} scores need as many positives or negatives and groups, got {len(of)} "
            f"and {len(group)}"
        )
    if not np.isfinite(every).all():
        raise UserError("scores must be finite: the model gave nan or inf")
    if of.all() or not of.any():
        return Estimate(math.nan, 0.0, 1.0, len(every), "area under the ROC curve")
    positives, negatives = int(of.sum()), int((~of).sum())
    wins = scipy.stats.rankdata(every)[of].sum() - positives * (positives + 1) / 2
    value = float(wins / (positives * negatives))
    sizes = len(np.unique(group[of])), len(np.unique(group[~of]))
    low, high = _limit(value, 0.0, *sizes), _limit(value, 1.0, *sizes)
    by_groups = "" if groups is None else " by groups"
    return Estimate(
        value, low, high, len(every), f"area under the ROC curve, Newcombe interval{by_groups}"
    )


def _limit(value: float, end: float, m: int, n: int) -> float:
    """Return the area furthest from ``value`` towards an end that ``value`` does not refute."""

    def excess(area: float) -> float:
        """How much further away an area is than its own standard errors allow."""
        few = (m + n) / 2 - 1
        spread = 1 + few * (1 - area) / (2 - area) + few * area / (1 + area)
        return abs(value - area) - Z * math.sqrt(area * (1 - area) * spread / (m * n))

    if value == end:
        return end
    beside = value + (end - value) * 1e-9  # at 0 and 1 there is no error, and another root
    return float(scipy.optimize.brentq(excess, beside, end))
