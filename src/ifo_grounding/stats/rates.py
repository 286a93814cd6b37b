"""Rates of success and their differences."""

from __future__ import annotations

import math

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from ifo_grounding.errors import UserError
from ifo_grounding.stats.results import CONFIDENCE, Difference, Rate

TAIL = (1 - CONFIDENCE) / 2


def wilson(successes: int, count: int) -> Rate:
    """Return a rate with Wilson's score interval, right also near 0 and 1.

    Raises:
        UserError: unless both are whole and 0 <= successes <= count.

    >>> print(wilson(8, 10))
    80.0% [49.0, 94.3] (n=10)
    """
    if not (0 <= successes <= count and successes % 1 == count % 1 == 0):
        raise UserError(f"successes must be 0..count, both whole, got {successes} of {count}")
    successes, count = int(successes), int(count)
    if count == 0:
        return Rate(math.nan, 0.0, 1.0, 0, 0, "wilson")
    low, high = scipy.stats.binomtest(successes, count).proportion_ci(CONFIDENCE, method="wilson")
    return Rate(successes / count, float(low), float(high), successes, count, "wilson")


def reliability(probabilities: ArrayLike, happened: ArrayLike) -> list[tuple[float, Rate]]:
    """Compare probabilities with what happened, in ten bins of equal width.

    Args:
        probabilities: what was predicted, in [0, 1], [N].
        happened: what came true, bool [N].

    Returns:
        For each bin that is not empty the mean probability and the share of what came true, with
        Wilson's interval. The closer the two, the better calibrated (DeGroot and Fienberg 1983).

    >>> [(said, rate.rate) for said, rate in reliability([0.25, 0.25, 0.75], [0, 1, 1])]
    [(0.25, 0.5), (0.75, 1.0)]
    """
    said = np.asarray(probabilities, dtype=np.float64).ravel()
    true = np.asarray(happened, dtype=bool).ravel()
    if len(said) != len(true) or not ((said >= 0) & (said <= 1)).all():
        raise UserError("reliability needs probabilities within 0..1, and as many outcomes")
    places = np.minimum((said * 10).astype(int), 9)
    return [
        (float(said[here].mean()), wilson(int(true[here].sum()), int(here.sum())))
        for here in (places == place for place in np.unique(places))
    ]


def _as_matrix(outcomes: ArrayLike, name: str) -> NDArray[np.float64]:
    values = np.atleast_2d(np.asarray(outcomes, dtype=np.float64))
    if values.ndim != 2 or not values.size or not np.isin(values, (0.0, 1.0)).all():
        raise UserError(f"{name} must be True or False, 1 or 0, [scenes] or [seeds, scenes]")
    return values


def rate_over_seeds(outcomes: ArrayLike) -> Rate:
    """Return the mean success over training seeds, with an interval that counts their spread.

    It is a t interval, for other seeds and other scenes, widened to hold Wilson's of the pooled
    outcomes, so that it is never empty; where all are the same, Wilson's of the scenes. That of two
    or three seeds is wide. Seeds of which few fail by much are the hardest to cover.

    Args:
        outcomes: successes, bool [seeds, scenes], column j the same scene for every seed; [scenes]
            is one seed, with Wilson's interval.

    >>> print(rate_over_seeds([[1, 1, 0, 1], [1, 0, 0, 1]]).rate)
    0.625
    """
    values = _as_matrix(outcomes, "outcomes")
    if len(values) == 1:
        return wilson(int(values.sum()), values.size)
    mean, margin = float(values.mean()), _margin(*_standard_error(values))
    different = values.shape[1] if np.ptp(values) == 0 else values.size
    least = wilson(round(different * mean), different)
    return Rate(
        rate=mean,
        low=max(0.0, min(mean - margin, least.low)),
        high=min(1.0, max(mean + margin, least.high)),
        successes=int(values.sum()),
        count=values.size,
        method=f"t over {len(values)} seeds",
    )


def paired_difference(before: ArrayLike, after: ArrayLike) -> Difference:
    """Compare two policies on the same scenes.

    The interval is a t interval. Where all but fewer than ten scenes fared alike, it also covers
    the exact ones (Clopper and Pearson) of how many became better and of how many worse. With one
    seed ([scenes]) it speaks of this pair of policies, and the p-value is McNemar's exact test;
    with several ([seeds, scenes]) both are a t test's over seeds, whose variance also counts what
    the scenes that they share have in common and, where all seeds changed as much, what their
    scenes leave unexplained. Two seeds hardly ever pass it.

    Args:
        before: successes of the first policy, bool [scenes] or [seeds, scenes].
        after: successes of the second on the same scenes, same shape.

    Raises:
        UserError: where the shapes differ.

    >>> difference = paired_difference([0, 0, 1, 1], [1, 0, 1, 1])
    >>> difference.points, difference.better, difference.worse, difference.p_value
    (25.0, 1, 0, 1.0)
    """
    first, second = _as_matrix(before, "before"), _as_matrix(after, "after")
    if first.shape != second.shape:
        raise UserError(
            "before and after must hold the same scenes in the same order, got "
            f"{list(np.shape(before))} and {list(np.shape(after))}"
        )
    change = second - first
    seeds = len(change)
    better, worse = int((change > 0).sum()), int((change < 0).sum())
    mean, (error, freedom) = float(change.mean()), _standard_error(change)
    margin = _margin(error, freedom)
    bounds = [mean - margin, mean + margin, *_exact_bounds(better, worse, *change.shape)]
    if seeds == 1:
        changed = better + worse
        p_value = float(scipy.stats.binomtest(better, changed).pvalue) if changed else 1.0
        method = "t over scenes, exact McNemar test"
    else:
        p_value = _t_test(mean, error, freedom, scenes=change.shape[1])
        method = f"t over {seeds} seeds"
    return Difference(
        points=100 * mean,
        low=100 * max(-1.0, min(bounds)),
        high=100 * min(1.0, max(bounds)),
        better=better,
        worse=worse,
        count=change.size,
        p_value=p_value,
        method=method,
    )


def _exact_bounds(better: int, worse: int, seeds: int, scenes: int) -> list[float]:
    """Return what a difference may be by exact intervals, where nearly all scenes fared alike.

    That is where fewer than ten changed, or all but fewer than ten were won, or lost.
    """
    up, down, size = better / seeds, worse / seeds, seeds * scenes
    few, won, lost = (others < 10 for others in (better + worse, size - better, size - worse))
    bounds = []
    if few or won:
        bounds.append(_exact_upper(up, scenes) - down / scenes)
    if few or lost:
        bounds.append(up / scenes - _exact_upper(down, scenes))
    if won:
        bounds.append(1 - _exact_upper(scenes - up, scenes) - down / scenes)
    if lost:
        bounds.append(up / scenes - 1 + _exact_upper(scenes - down, scenes))
    return bounds


def _exact_upper(count: float, of: int) -> float:
    """Return Clopper and Pearson's upper bound of a share; the count, a mean, may be no whole."""
    return 1.0 if count >= of else float(scipy.stats.beta.ppf(1 - TAIL, count + 1, of - count))


def _standard_error(values: NDArray[np.float64]) -> tuple[float, int]:
    """Return that of the mean of [seeds, scenes], for others of both, and its degrees of freedom.

    Of one seed, for other scenes.
    """
    seeds, scenes = values.shape
    if seeds == 1:
        return (math.sqrt(values.var(ddof=1) / scenes) if scenes > 1 else 0.0), scenes - 1
    by_seed, by_scene = values.mean(1, keepdims=True), values.mean(0, keepdims=True)
    error = by_seed.var(ddof=1) / seeds
    if scenes > 1:
        # What seeds and scenes leave unexplained is in the variance of both means: counted once.
        rest = ((values - by_seed - by_scene + values.mean()) ** 2).sum()
        rest /= (seeds - 1) * (scenes - 1) * values.size
        error += max(0.0, by_scene.var(ddof=1) / scenes - rest)
        if np.ptp(values.sum(1)) == 0:  # seeds that agree by chance are no proof of no spread
            error = max(error, rest)
    return math.sqrt(error), seeds - 1


def _margin(error: float, freedom: int) -> float:
    """Return half the width of a t interval."""
    return float(error * scipy.stats.t.ppf(1 - TAIL, freedom)) if error else 0.0


def _t_test(mean: float, error: float, freedom: int, scenes: int) -> float:
    """Return the p-value of no mean change."""
    if not error:  # every scene fares alike with every seed
        return float(scipy.stats.binomtest(scenes, scenes).pvalue) if mean else 1.0
    return float(2 * scipy.stats.t.sf(abs(mean) / error, freedom))


def holm(p_values: ArrayLike) -> list[float]:
    """Adjust p-values for their number (Holm 1979), in the given order.

    >>> holm([0.01, 0.04, 0.03])
    [0.03, 0.06, 0.06]
    """
    p = np.asarray(p_values, dtype=np.float64)
    if p.ndim != 1 or not ((p >= 0) & (p <= 1)).all():
        raise UserError("p_values must be a list of numbers within 0..1")
    order = np.argsort(p, kind="stable")
    steps = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.minimum(steps, 1.0)[np.argsort(order)].tolist()
