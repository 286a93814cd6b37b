"""Tables for the terminal and for markdown."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from ifo_grounding.errors import UserError
from ifo_grounding.stats import Difference, Estimate, Rate

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
    return str(value)


def is_number(value: Any) -> bool:
    """Return whether a column of such values reads better aligned to the right."""
    return isinstance(value, (int, float, Rate, Estimate, Difference)) or value is None


def columns_of(rows: Sequence[Row], columns: Sequence[str] | None = None) -> list[str]:
    """Return the columns of a table: those asked for, or all in order of appearance."""
    if columns is not None:
        return list(columns)
    return list(dict.fromkeys(name for row in rows for name in row))


def _cells(rows: Sequence[Row], names: list[str]) -> list[list[str]]:
    return [[format_cell(row.get(name)) for name in names] for row in rows]


def _aligned_right(rows: Sequence[Row], name: str) -> bool:
    return bool(rows) and all(is_number(row.get(name)) for row in rows)


def text_table(
    rows: Sequence[Row], columns: Sequence[str] | None = None, *, title: str | None = None
) -> str:
    """Return a table for the terminal.

    Args:
        rows: what each column says, per row; a :class:`~ifo_grounding.stats.Rate` and its like
            are written with their intervals.
        columns: which columns, in which order; all that appear where None.
        title: a line above.

    >>> print(text_table([{"task": "move", "share": 0.5}, {"task": "pick-out", "share": 0.25}]))
    task      share
    --------  -----
    move        0.5
    pick-out   0.25
    """
    if not rows:
        raise UserError("a table needs at least one row")
    names = columns_of(rows, columns)
    cells = _cells(rows, names)
    widths = [max(len(line[i]) for line in [names, *cells]) for i in range(len(names))]
    right = [_aligned_right(rows, name) for name in names]

    def line(texts: Sequence[str]) -> str:
        padded = [
            text.rjust(width) if at_right else text.ljust(width)
            for text, width, at_right in zip(texts, widths, right, strict=True)
        ]
        return "  ".join(padded).rstrip()

    lines = [line(names), line(["-" * width for width in widths]), *map(line, cells)]
    return "\n".join([title, *lines] if title else lines)


def markdown_table(rows: Sequence[Row], columns: Sequence[str] | None = None) -> str:
    """Return a table in markdown; arguments as :func:`text_table`.

    Browsers do not break lines within an interval: there its space is a non-breaking one.

    >>> print(markdown_table([{"task": "move", "share": 0.5}]))
    | task | share |
    | --- | ---: |
    | move | 0.5 |
    """
    if not rows:
        raise UserError("a table needs at least one row")
    names = columns_of(rows, columns)
    rule = ["---:" if _aligned_right(rows, name) else "---" for name in names]
    escaped = [[_escaped(text) for text in row] for row in _cells(rows, names)]
    return "\n".join(f"| {' | '.join(row)} |" for row in [names, rule, *escaped])


def _escaped(text: str) -> str:
    """Return a cell as markdown takes it."""
    return INTERVAL.sub("[\\1,\u00a0\\2]", text.replace("|", r"\|"))


def renewed(text: str, mark: str, part: str) -> str:
    """Return a page with the part between two marks renewed.

    >>> renewed("a <!-- x --> old <!-- /x --> b", "x", " new ")
    'a <!-- x --> new <!-- /x --> b'
    """
    first, last = f"<!-- {mark} -->", f"<!-- /{mark} -->"
    before, _, rest = text.partition(first)
    _, _, after = rest.partition(last)
    return f"{before}{first}{part}{last}{after}"


def folded(title: str, lines: Sequence[str]) -> str:
    r"""Return lines as a note of the docs that is folded away; nothing where there is none.

    >>> folded("Commands", ["- one"])
    '??? note "Commands"\n\n    - one'
    """
    if not lines:
        return ""
    return "\n".join([f'??? note "{title}"', "", *(f"    {line}" for line in lines)])
