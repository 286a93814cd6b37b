"""Numbers with their intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

CONFIDENCE = 0.95
"""Coverage of every interval."""


def _digits(rate: float, width: float) -> int:
    """Decimals that round away neither a rare failure or success nor its interval's width."""
    rare = min(rate, 1.0 - rate)
    if not rare:
        return 1 if width >= 0.0005 else 2 if width >= 0.00005 else 3
    if rare < 0.00005:
        return 3
    return 2 if rare < 0.0005 or width < 0.0015 else 1


class Described:
    """Gives a result dataclass a form for JSON, and its first field, the headline, as its text."""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain values; what is undefined becomes None, arrays are left out.

        >>> Rate(math.nan, 0.0, 1.0, 0, 0).as_dict()["rate"] is None
        True
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        return {k: plain(v) for k, v in values.items() if not hasattr(v, "shape")}

    def __str__(self) -> str:
        """Return the headline with its interval."""
        return str(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]


def plain(value: Any) -> Any:
    """Return results as values for JSON.

    >>> from pathlib import Path
    >>> plain({"none": math.nan, "pair": (1, 2), "path": Path("demos")})
    {'none': None, 'pair': [1, 2], 'path': 'demos'}
    """
    if isinstance(value, Described):
        return value.as_dict()
    if isinstance(value, Mapping):
        return {str(name): plain(part) for name, part in value.items()}
    if hasattr(value, "tolist"):  # arrays and tensors
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


@dataclass(frozen=True)
class Rate(Described):
    """A share of successes with its interval; shares lie within 0..1.

    >>> print(Rate(0.973, 0.961, 0.982, successes=1946, count=2000, method="wilson"))
    97.3% [96.1, 98.2] (n=2000)
    """

    rate: float
    """Successes / count; not a number where count is 0."""
    low: float
    """Lower bound of the interval."""
    high: float
    """Upper bound of the interval."""
    successes: int
    """How many succeeded."""
    count: int
    """Out of how many."""
    method: str = "wilson"
    """How the interval was computed."""

    def __str__(self) -> str:
        """Return the rate in percent, its interval and the count."""
        if not self.count:
            return "undefined (n=0)"
        digits = _digits(self.rate, self.high - self.low)
        rate, low, high = (f"{100 * x:.{digits}f}" for x in (self.rate, self.low, self.high))
        return f"{rate}% [{low}, {high}] (n={self.count})"


@dataclass(frozen=True)
class Estimate(Described):
    """A number other than a rate (an area, a correlation) with its interval.

    >>> print(Estimate(0.912, 0.9, 0.924, count=500, method="delong"))
    0.912 [0.900, 0.924] (n=500)
    """

    value: float
    """The estimate; not a number where it is undefined."""
    low: float
    """Lower bound of the interval."""
    high: float
    """Upper bound of the interval."""
    count: int
    """How many observations it rests on."""
    method: str
    """How it was computed."""

    def __str__(self) -> str:
        """Return the value, its interval and the count."""
        if not math.isfinite(self.value):
            return f"undefined (n={self.count})"
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}] (n={self.count})"


@dataclass(frozen=True)
class Difference(Described):
    """What changed between two policies on the same scenes, in percentage points.

    >>> print(Difference(2.5, 1.0, 4.0, better=60, worse=10, count=2000, p_value=1e-9, method=""))
    +2.5 points [+1.0, +4.0] (60 better, 10 worse, n=2000)

    A bound that one digit would round to zero gets more:

    >>> print(Difference(0.2, 0.02, 0.3, better=10, worse=2, count=5000, p_value=0.04, method=""))
    +0.20 points [+0.02, +0.30] (10 better, 2 worse, n=5000)
    """

    points: float
    """Mean of after minus before, in percentage points."""
    low: float
    """Lower bound of the interval, in points."""
    high: float
    """Upper bound of the interval, in points."""
    better: int
    """Scenes that failed before and succeed after."""
    worse: int
    """Scenes that succeeded before and fail after."""
    count: int
    """Pairs compared."""
    p_value: float
    """Two-sided p-value of no difference."""
    method: str
    """How interval and p-value were computed."""

    def __str__(self) -> str:
        """Return the difference, its interval and how many scenes changed."""
        changed = f"{self.better} better, {self.worse} worse, n={self.count}"
        nearest = min((abs(bound) for bound in (self.low, self.high) if bound), default=1.0)
        digits = 3 if nearest < 0.005 else 2 if nearest < 0.05 or self.high - self.low < 0.25 else 1
        points, low, high = (f"{x:+.{digits}f}" for x in (self.points, self.low, self.high))
        return f"{points} points [{low}, {high}] ({changed})"
