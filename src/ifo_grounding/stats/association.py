"""How well one number tells another: areas under the ROC curve and correlations."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize
from scipy import stats as scipy_stats

from ifo_grounding.errors import UserError
from ifo_grounding.stats.results import CONFIDENCE, Estimate

Z = float(scipy_stats.norm.ppf(0.5 + CONFIDENCE / 2))
"""Standard errors on either side of an estimate that a normal interval covers."""


def auc(scores: ArrayLike, positive: ArrayLike, groups: ArrayLike | None = None) -> Estimate:
    """Return the probability that a positive scores above a negative, ties counting half.

    The interval is DeLong's (1988); where groups are given (scores from one demonstration belong
    together) Obuchowski's (1997) for clustered data. Both are too narrow near 0 and 1 and where one
    kind has few scores, so that the interval also covers Newcombe's (2006, method 5) for as many
    scores as there are groups, which inverts the variance of Hanley and McNeil.

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
    # A score's rank among all, less its rank among its own kind, counts those it beats.
    ranks = scipy_stats.rankdata(every)
    wins = (ranks[of] - scipy_stats.rankdata(every[of])) / (~of).sum()
    losses = 1 - (ranks[~of] - scipy_stats.rankdata(every[~of])) / of.sum()
    value = float(wins.mean())
    error = _clustered_error(wins - value, losses - value, group[of], group[~of])
    sizes = len(np.unique(group[of])), len(np.unique(group[~of]))
    by_groups = "" if groups is None else " by groups"
    return Estimate(
        value,
        low=min(max(0.0, value - Z * error), _limit(value, 0.0, *sizes)),
        high=max(min(1.0, value + Z * error), _limit(value, 1.0, *sizes)),
        count=len(every),
        method=f"area under the ROC curve, DeLong and Newcombe{by_groups}",
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
    return float(optimize.brentq(excess, beside, end))


def _clustered_error(
    x: NDArray[np.float64], y: NDArray[np.float64], gx: NDArray[Any], gy: NDArray[Any]
) -> float:
    """Standard error of an area from the centred placements of groups."""
    names, index = np.unique(np.concatenate([gx, gy]), return_inverse=True)
    sum_x = np.bincount(index[: len(x)], weights=x, minlength=len(names)) / len(x)
    sum_y = np.bincount(index[len(x) :], weights=y, minlength=len(names)) / len(y)

    def unbiased(groups: int) -> float:
        return groups / max(groups - 1, 1)

    variance = unbiased(len(np.unique(gx))) * (sum_x**2).sum()
    variance += unbiased(len(np.unique(gy))) * (sum_y**2).sum()
    variance += 2 * unbiased(len(names)) * (sum_x * sum_y).sum()
    return math.sqrt(max(0.0, float(variance)))


def correlation(first: ArrayLike, second: ArrayLike) -> Estimate:
    """Return Pearson's correlation (point-biserial where one is a success) and Fisher's interval.

    It is undefined where either does not vary.

    >>> round(correlation([0, 1, 0, 1], [1.0, 2.0, 1.0, 2.0]).value, 6)
    1.0
    """
    x, y = np.asarray(first, np.float64).ravel(), np.asarray(second, np.float64).ravel()
    if len(x) != len(y):
        raise UserError(f"correlation needs pairs, got {len(x)} and {len(y)} values")
    method = "Pearson correlation, Fisher interval"
    if len(x) < 4 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return Estimate(math.nan, -1.0, 1.0, len(x), method)
    found = scipy_stats.pearsonr(x, y)
    interval = found.confidence_interval(CONFIDENCE)
    return Estimate(
        float(found.statistic), float(interval.low), float(interval.high), len(x), method
    )
