"""Tables for the terminal and for markdown."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from ifo_grounding.errors import UserError
from ifo_grounding.stats import Difference, Estimate, Rate
from ifo_grounding.texts import markdown_cell, one_line

Row = Mapping[str, Any]
"""One row of a table: what each column says."""

MISSING = "–"
INTERVAL = re.compile(r"\[([^\s,\]]+), ([^\s,\]]+)\]")


def format_cell(value: Any) -> str:
    """Return what a table shows for a value: intervals in full, other numbers short.

    >>> format_cell(0.123456), format_cell(12_000), format_cell(None), format_cell(True)
    ('0.123', '12,000', '–', 'yes')
    """
    if value is None:
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.3g}" if math.isfinite(value) else MISSING
    return one_line(value)


def is_number(value: Any) -> bool:
    """Return whether a column of such values reads better aligned to the right."""
    return isinstance(value, (int, float, Rate, Estimate, Difference)) or value is None


def columns_of(rows: Sequence[Row]) -> list[str]:
    """Return the columns of a table, in order of appearance."""
    if not rows:
        raise UserError("a table needs at least one row")
    return list(dict.fromkeys(name for row in rows for name in row))


def _aligned_right(rows: Sequence[Row], name: str) -> bool:
    return all(is_number(row.get(name)) for row in rows)


def text_table(rows: Sequence[Row]) -> str:
    """Return a table for the terminal.

    Args:
        rows: what each column says, per row; a :class:`~ifo_grounding.stats.Rate` and its like
            are written with their intervals.

    >>> print(text_table([{"task": "move", "share": 0.5}, {"task": "pick-out", "share": 0.25}]))
    task      share
    --------  -----
    move        0.5
    pick-out   0.25
    """
    columns = []
    for name in columns_of(rows):
        cells = [format_cell(name), *(format_cell(row.get(name)) for row in rows)]
        width = max(map(len, cells))
        cells.insert(1, "-" * width)
        right = _aligned_right(rows, name)
        columns.append([cell.rjust(width) if right else cell.ljust(width) for cell in cells])
    return "\n".join("  ".join(cells).rstrip() for cells in zip(*columns, strict=True))


def markdown_table(rows: Sequence[Row]) -> str:
    """Return a table in markdown; rows as for :func:`text_table`.

    Browsers do not break lines within an interval: there its space is a non-breaking one.

    >>> print(markdown_table([{"task": "move", "share": 0.5}]))
    | task | share |
    | --- | ---: |
    | move | 0.5 |
    """
    names = columns_of(rows)
    rule = ["---:" if _aligned_right(rows, name) else "---" for name in names]
    cells = [[_escaped(format_cell(row.get(name))) for name in names] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in [map(_escaped, names), rule, *cells])


def _escaped(text: str) -> str:
    """Return a cell as markdown takes it."""
    return INTERVAL.sub("[\\1,\u00a0\\2]", markdown_cell(text))
