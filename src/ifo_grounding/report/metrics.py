"""Reading the metrics that a run has logged."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable
from pathlib import Path

from ifo_grounding.errors import UserError

Series = tuple[list[float], list[float]]
"""Steps and values of one metric."""


def read_metrics(path: str | Path) -> dict[str, Series]:
    r"""Read logged metrics.

    Understands JSON lines (one object per line), CSV with a header (both with a column ``step``,
    else rows are numbered), and the folder of TorchRL's ``CSVLogger`` (one headerless
    ``<metric>.csv`` of step, value each, also nested). A last line that was cut short by a kill is
    ignored, and steps that a resumed run logged again count once.

    Args:
        path: a ``.jsonl`` or ``.csv`` file, or a folder.

    Returns:
        Steps and values of each metric, by name.

    Raises:
        UserError: where there is nothing to read, or a file is not what its ending says.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "metrics.jsonl"
    >>> _ = path.write_text('{"step": 0, "loss": 2.0}\n{"step": 10, "loss": 1.0}\n')
    >>> read_metrics(path)
    {'loss': ([0.0, 10.0], [2.0, 1.0])}
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path)
    if not path.exists():
        raise UserError(f"{path} does not exist: give the metrics file or log folder of a run")
    if path.suffix == ".jsonl":
        series = _collect(_json_rows(path))
    elif path.suffix == ".csv":
        series = _collect(csv.DictReader(_whole_lines(path)))
    else:
        raise UserError(f"{path} is neither .jsonl nor .csv nor a folder of metrics")
    if not series:
        raise UserError(f"{path} holds no metrics: give the metrics file or log folder of a run")
    return series


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines(keepends=True)
    except UnicodeDecodeError:
        raise UserError(f"{path} is no text: give the metrics of a run") from None


def _whole_lines(path: Path) -> list[str]:
    """Return the lines of a file but for a last one that was cut short: a cut number is one too."""
    lines = _lines(path)
    return lines[:-1] if lines and not lines[-1].endswith("\n") else lines


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _json_rows(path: Path) -> list[dict[str, object]]:
    lines = _lines(path)
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            if number < len(lines):
                raise UserError(f"{path}, line {number} is not JSON: {line[:60]!r}") from None
            continue
        if not isinstance(row, dict):
            raise UserError(f"{path}, line {number} is no JSON object: {line[:60]!r}")
        rows.append(row)
    return rows


def _append(series: dict[str, Series], name: str, step: float, value: float) -> None:
    """Add a value; a run that resumed repeats steps, and what it logged last counts."""
    steps, values = series.setdefault(name, ([], []))
    while steps and steps[-1] >= step:
        steps.pop()
        values.pop()
    steps.append(step)
    values.append(value)


def _collect(rows: Iterable[dict[str, object]]) -> dict[str, Series]:
    series: dict[str, Series] = {}
    for index, row in enumerate(rows):
        step = _number(row.get("step"))
        for name, value in row.items():
            number = _number(value)
            if name != "step" and number is not None and not isinstance(value, bool):
                _append(series, name, float(index) if step is None else step, number)
    return series


def _read_folder(folder: Path) -> dict[str, Series]:
    series: dict[str, Series] = {}
    for file in sorted(folder.rglob("*.csv")):
        parts = file.relative_to(folder).with_suffix("").parts
        name = "/".join(part for part in parts if part != "scalars")
        for line in _whole_lines(file):
            pair = [_number(part) for part in line.split(",")]
            if len(pair) == 2 and pair[0] is not None and pair[1] is not None:
                _append(series, name, pair[0], pair[1])
    if not series:
        raise UserError(f"{folder} holds no metrics: give the log folder of a run")
    return series
