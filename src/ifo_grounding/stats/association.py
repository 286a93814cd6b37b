"""How well one number tells another: areas under the ROC curve and correlations."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize
from scipy import stats as scipy_stats

from ifo_grounding.errors import UserError
from ifo_grounding.stats.results import Estimate, check_confidence


def auc(
    positive: ArrayLike,
    negative: ArrayLike,
    *,
    positive_groups: ArrayLike | None = None,
    negative_groups: ArrayLike | None = None,
    confidence: float = 0.95,
) -> Estimate:
    """Return the probability that a positive scores above a negative, ties counting half.

    The interval is DeLong's (1988); where groups are given (scores from one demonstration belong
    together) Obuchowski's (1997) for clustered data. Both are too narrow near 0 and 1 and where one
    kind has few scores, so that the interval also covers Newcombe's (2006, method 5) for as many
    scores as there are groups, which inverts the variance of Hanley and McNeil.

    Args:
        positive: scores that should be high, [N].
        negative: scores that should be low, [M].
        positive_groups: which group each positive belongs to, integer [N].
        negative_groups: the same for the negatives, integer [M].
        confidence: coverage of the interval.

    >>> auc([2.0, 3.0], [1.0, 2.0]).value
    0.875
    """
    check_confidence(confidence)
    x, y = np.asarray(positive, np.float64).ravel(), np.asarray(negative, np.float64).ravel()
    count = len(x) + len(y)
    if not len(x) or not len(y):
        return Estimate(math.nan, 0.0, 1.0, count, "area under the ROC curve")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise UserError("scores must be finite: the judge gave nan or inf")
    # A score's rank among all, less its rank among its own kind, counts those it beats.
    ranks = scipy_stats.rankdata(np.concatenate([x, y]))
    wins = (ranks[: len(x)] - scipy_stats.rankdata(x)) / len(y)
    losses = 1 - (ranks[len(x) :] - scipy_stats.rankdata(y)) / len(x)
    value = float(wins.mean())
    grouped = positive_groups is not None
    if grouped is (negative_groups is None):
        raise UserError("give groups of both kinds of scores, or of none")
    gx = np.asarray(positive_groups if grouped else np.arange(len(x))).ravel()
    gy = np.asarray(negative_groups if grouped else len(x) + np.arange(len(y))).ravel()
    error = _clustered_error(wins - value, losses - value, gx, gy)
    z = float(scipy_stats.norm.ppf(0.5 + confidence / 2))
    low, high = max(0.0, value - z * error), min(1.0, value + z * error)
    method = "area under the ROC curve, DeLong and Newcombe" + (" by groups" if grouped else "")
    sizes = len(np.unique(gx)), len(np.unique(gy))
    low, high = min(low, _limit(value, 0.0, *sizes, z)), max(high, _limit(value, 1.0, *sizes, z))
    return Estimate(value, low, high, count, method)


def _limit(value: float, end: float, m: int, n: int, z: float) -> float:
    """Return the area furthest from ``value`` towards an end that ``value`` does not refute."""

    def excess(area: float) -> float:
        """How much further away an area is than its own standard errors allow."""
        few = (m + n) / 2 - 1
        spread = 1 + few * (1 - area) / (2 - area) + few * area / (1 + area)
        return abs(value - area) - z * math.sqrt(area * (1 - area) * spread / (m * n))

    if value == end:
        return end
    beside = value + (end - value) * 1e-9  # at 0 and 1 there is no error, and another root
    return float(optimize.brentq(excess, beside, end))


def _clustered_error(
    x: NDArray[np.float64], y: NDArray[np.float64], gx: NDArray[Any], gy: NDArray[Any]
) -> float:
    """Standard error of an area from the centred placements of groups."""
    if len(gx) != len(x) or len(gy) != len(y):
        raise UserError("groups must name one group per score")
    names, index = np.unique(np.concatenate([gx, gy]), return_inverse=True)
    sum_x = np.bincount(index[: len(x)], weights=x, minlength=len(names)) / len(x)
    sum_y = np.bincount(index[len(x) :], weights=y, minlength=len(names)) / len(y)

    def spread(member: NDArray[Any]) -> float:
        groups = len(np.unique(member))
        return groups / max(groups - 1, 1)

    variance = spread(gx) * (sum_x**2).sum() + spread(gy) * (sum_y**2).sum()
    both = len(names) / max(len(names) - 1, 1)
    return math.sqrt(max(0.0, float(variance + 2 * both * (sum_x * sum_y).sum())))


def correlation(first: ArrayLike, second: ArrayLike, confidence: float = 0.95) -> Estimate:
    """Return Pearson's correlation (point-biserial where one is a success) and Fisher's interval.

    It is undefined where either does not vary.

    >>> round(correlation([0, 1, 0, 1], [1.0, 2.0, 1.0, 2.0]).value, 6)
    1.0
    """
    check_confidence(confidence)
    x, y = np.asarray(first, np.float64).ravel(), np.asarray(second, np.float64).ravel()
    if len(x) != len(y):
        raise UserError(f"correlation needs pairs, got {len(x)} and {len(y)} values")
    method = "Pearson correlation, Fisher interval"
    if len(x) < 4 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return Estimate(math.nan, -1.0, 1.0, len(x), method)
    value = float(np.clip(np.corrcoef(x, y)[0, 1], -1.0, 1.0))
    half = float(scipy_stats.norm.ppf(0.5 + confidence / 2)) / math.sqrt(len(x) - 3)
    centre = math.atanh(np.clip(value, -1 + 1e-12, 1 - 1e-12))
    return Estimate(value, math.tanh(centre - half), math.tanh(centre + half), len(x), method)
