"""Rates of success and their differences."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats as scipy_stats

from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.stats.results import Difference, Rate, check_confidence

RESAMPLES = 4000
"""Bootstrap replicates unless told otherwise: bounds are stable to about a tenth of a width."""
FEW_CHANGES = 10
"""Scenes that changed, below which a bootstrap of differences is not trusted alone."""


def wilson(successes: int, count: int, confidence: float = 0.95) -> Rate:
    """Return a rate with Wilson's score interval, right also near 0 and 1.

    Raises:
        UserError: unless both are whole and 0 <= successes <= count.

    >>> print(wilson(8, 10))
    80.0% [49.0, 94.3] (n=10)
    """
    check_confidence(confidence)
    if not (0 <= successes <= count and successes % 1 == count % 1 == 0):
        raise UserError(f"successes must be 0..count, both whole, got {successes} of {count}")
    successes, count = int(successes), int(count)
    if count == 0:
        return Rate(math.nan, 0.0, 1.0, 0, 0, "wilson")
    z = float(scipy_stats.norm.ppf(0.5 + confidence / 2))
    rate = successes / count
    shrink = 1.0 + z * z / count
    centre = (rate + z * z / (2 * count)) / shrink
    half = z / shrink * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == count else min(1.0, centre + half)
    return Rate(rate, low, high, successes, count, "wilson")


def _resampled_means(
    values: NDArray[np.float64], resamples: int, shared_scenes: bool, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Means of resampled [seeds, scenes] values: seeds first, then scenes.

    Scenes in which every seed came out alike are drawn by their number, which is the same as one by
    one and takes hardly longer for many scenes than for few.
    """
    seeds, scenes = values.shape
    seed = rng.integers(seeds, size=(resamples, seeds))
    if shared_scenes:
        patterns, counts = np.unique(values, axis=1, return_counts=True)
        drawn = rng.multinomial(scenes, counts / scenes, size=resamples)
        by_seed = drawn @ patterns.T / scenes
        return np.take_along_axis(by_seed, seed, axis=1).mean(1)
    kinds = np.unique(values)
    shares = (values[:, :, None] == kinds).mean(1)
    return (rng.multinomial(scenes, shares[seed]) @ kinds / scenes).mean(1)


def _as_matrix(outcomes: ArrayLike, name: str) -> NDArray[np.float64]:
    values = np.asarray(outcomes, dtype=np.float64)
    if values.ndim == 1:
        values = values[None]
    if values.ndim != 2 or not values.size:
        raise UserError(f"{name} must be [scenes] or [seeds, scenes], got {list(values.shape)}")
    if not np.isin(values, (0.0, 1.0)).all():
        raise UserError(f"{name} must be successes and failures (True or False, 1 or 0)")
    return values


def two_level_bootstrap(
    outcomes: ArrayLike,
    *,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
    shared_scenes: bool = True,
) -> Rate:
    """Return the mean success over training seeds, with an interval that counts their spread.

    Each replicate draws seeds with replacement, then scenes. The interval is a percentile interval,
    widened to hold Wilson's of the pooled outcomes, so that it is never empty; where all outcomes
    are the same, Wilson's of the different scenes. With few seeds it is too narrow, as every
    bootstrap is: it knows of no spread but theirs.

    Args:
        outcomes: successes, bool [seeds, scenes]; [scenes] is one seed.
        confidence: coverage of the interval.
        resamples: number of replicates.
        seed: of the resampling.
        shared_scenes: whether column j is the same scene for every seed (as evaluation scenes
            are), so that scenes are drawn once per replicate rather than once per seed.

    >>> print(two_level_bootstrap([[1, 1, 0, 1], [1, 0, 0, 1]]).rate)
    0.625
    """
    check_confidence(confidence)
    at_least_one("resamples", resamples)
    values = _as_matrix(outcomes, "outcomes")
    rng = np.random.default_rng(seed)
    means = _resampled_means(values, resamples, shared_scenes, rng)
    tail = (1 - confidence) / 2
    same = shared_scenes and values.min() == values.max()
    different = values.shape[1] if same else values.size
    least = wilson(round(different * float(values.mean())), different, confidence)
    low, high = np.quantile(means, (tail, 1 - tail))
    return Rate(
        rate=float(values.mean()),
        low=min(float(low), least.low),
        high=max(float(high), least.high),
        successes=int(values.sum()),
        count=values.size,
        method=f"bootstrap over {len(values)} seeds and their scenes",
    )


def paired_difference(
    before: ArrayLike,
    after: ArrayLike,
    *,
    confidence: float = 0.95,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Difference:
    """Compare two policies on the same scenes.

    The interval comes from the two-level bootstrap. Where all but fewer than ten scenes fared
    alike, which a bootstrap tells little from, it also covers the exact ones (Clopper and Pearson)
    of how many became better and of how many worse. With one seed ([scenes]) the p-value is
    McNemar's exact test, and speaks of this pair of policies; with several ([seeds, scenes]) it is
    a t test over seeds, whose variance also counts what the scenes that they share have in common
    and, where all seeds changed as much, what their scenes leave unexplained.
    Two seeds hardly ever pass it, however narrow the interval. With several seeds the interval is
    rather too wide where they hardly differ, and too narrow where they differ by much.

    Args:
        before: successes of the first policy, bool [scenes] or [seeds, scenes].
        after: successes of the second on the same scenes, same shape.
        confidence: coverage of the interval.
        resamples: number of replicates.
        seed: of the resampling.

    Raises:
        UserError: where the shapes differ.

    >>> difference = paired_difference([0, 0, 1, 1], [1, 0, 1, 1])
    >>> difference.points, difference.better, difference.worse, difference.p_value
    (25.0, 1, 0, 1.0)
    """
    check_confidence(confidence)
    at_least_one("resamples", resamples)
    first, second = _as_matrix(before, "before"), _as_matrix(after, "after")
    if first.shape != second.shape:
        raise UserError(
            "before and after must hold the same scenes in the same order, got "
            f"{list(np.shape(before))} and {list(np.shape(after))}"
        )
    change = second - first
    better, worse = int((change > 0).sum()), int((change < 0).sum())
    tail = (1 - confidence) / 2
    rng = np.random.default_rng(seed)
    means = _resampled_means(change, resamples, True, rng)
    low, high = (float(q) for q in np.quantile(means, (tail, 1 - tail)))
    up, down = better / len(change), worse / len(change)  # of one seed
    scenes = change.shape[1]
    few, won, lost = (
        others < FEW_CHANGES
        for others in (better + worse, change.size - better, change.size - worse)
    )
    if few or won:
        high = max(high, _exact_upper(up, scenes, tail) - down / scenes)
    if few or lost:
        low = min(low, up / scenes - _exact_upper(down, scenes, tail))
    if won:
        low = min(low, 1 - _exact_upper(scenes - up, scenes, tail) - down / scenes)
    if lost:
        high = max(high, up / scenes - 1 + _exact_upper(scenes - down, scenes, tail))
    if len(change) == 1:
        p_value = 1.0
        if better + worse:
            p_value = float(scipy_stats.binomtest(better, better + worse).pvalue)
        method = "bootstrap over scenes, exact McNemar test"
    else:
        p_value = _t_test(change)
        method = f"bootstrap over {len(change)} seeds and their scenes, t test over seeds"
    return Difference(
        points=100 * float(change.mean()),
        low=100 * low,
        high=100 * high,
        better=better,
        worse=worse,
        count=change.size,
        p_value=p_value,
        method=method,
    )


def _exact_upper(count: float, of: int, tail: float) -> float:
    """Return the upper bound of Clopper and Pearson's interval of a share."""
    return 1.0 if count >= of else float(scipy_stats.beta.ppf(1 - tail, count + 1, of - count))


def _t_test(change: NDArray[np.float64]) -> float:
    """Return the p-value of no mean change in [seeds, scenes], for other seeds and other scenes."""
    seeds, scenes = change.shape
    by_seed, by_scene = change.mean(1, keepdims=True), change.mean(0, keepdims=True)
    error = by_seed.var(ddof=1) / seeds
    if scenes > 1:
        # What seeds and scenes leave unexplained is in the variance of both means: counted once.
        rest = ((change - by_seed - by_scene + change.mean()) ** 2).sum()
        rest /= (seeds - 1) * (scenes - 1) * change.size
        error += max(0.0, by_scene.var(ddof=1) / scenes - rest)
        if np.ptp(change.sum(1)) == 0:  # seeds that agree by chance are no proof of no spread
            error = max(error, rest)
    error = math.sqrt(error)
    if not error:  # every scene fares alike with every seed
        return float(scipy_stats.binomtest(scenes, scenes).pvalue) if change.mean() else 1.0
    return float(2 * scipy_stats.t.sf(abs(change.mean()) / error, seeds - 1))


def holm(p_values: Sequence[float] | ArrayLike) -> list[float]:
    """Adjust p-values for their number (Holm 1979), in the given order.

    >>> holm([0.01, 0.04, 0.03])
    [0.03, 0.06, 0.06]
    """
    p = np.asarray(p_values, dtype=np.float64)
    if p.ndim != 1 or not ((p >= 0) & (p <= 1)).all():
        raise UserError("p_values must be a list of numbers within 0..1")
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    steps = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted[order] = np.minimum(steps, 1.0)
    return [float(value) for value in adjusted]
