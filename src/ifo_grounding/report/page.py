"""A report as one page that needs nothing else: no network, no other files."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from ifo_grounding.errors import UserError
from ifo_grounding.files import atomic_write, write_json
from ifo_grounding.report.casestudy import Case, gallery
from ifo_grounding.report.drawing import upscaled
from ifo_grounding.report.plots import figure_png
from ifo_grounding.report.style import STYLE
from ifo_grounding.report.tables import columns_of, format_cell, is_number
from ifo_grounding.stats import Difference, Estimate, Rate

PIXELS_PER_INCH = 84
SUFFIXES = {b"\x89PNG": "png", b"GIF8": "gif", b"\xff\xd8\xff": "jpeg"}
Picture = Figure | bytes | str | Path | np.ndarray | Sequence[Case]
"""A matplotlib figure, an image file or its bytes, pixels uint8 [3, H, W], or cases."""


def write_report(
    folder: str | Path,
    results: Mapping[str, Any],
    pictures: Mapping[str, Picture] | None = None,
    *,
    title: str = "Report",
    summary: str = "",
    notes: Mapping[str, str] | None = None,
) -> Path:
    """Write a folder with ``index.html``, ``results.json`` and ``pictures/``.

    The page holds everything itself, so that it can be moved or sent alone. It adapts to phones and
    to dark mode.

    Args:
        folder: where; other files in it are left alone.
        results: what was measured, by heading. A number or an interval
            (:class:`~ifo_grounding.stats.Rate` and its like) becomes a headline on top; a mapping
            a table of two columns, a list of mappings a table with a column per key, a text a
            paragraph.
        pictures: by heading: matplotlib figures (drawn light and dark), image files or bytes,
            pixels uint8 [3, H, W], or lists of :class:`~ifo_grounding.report.Case`.
        title: of the page.
        summary: a sentence below the title.
        notes: sentences below headings of results or pictures, by heading.

    Returns:
        Path of the page.

    >>> import tempfile
    >>> page = write_report(tempfile.mkdtemp(), {"Success": Rate(0.9, 0.8, 0.95, 9, 10)})
    >>> page.name, sorted(path.name for path in page.parent.iterdir())
    ('index.html', ['index.html', 'results.json'])
    """
    folder = Path(folder)
    explained = dict(notes or {})
    unknown = set(explained) - set(results) - set(pictures or {})
    if unknown:
        raise UserError(f"notes about {sorted(unknown)}, which are no headings of the report")
    headlines = {name: value for name, value in results.items() if _is_headline(value)}
    parts = [_headlines(headlines)] if headlines else []
    for name, value in results.items():
        if name not in headlines:
            parts.append(_section(name, _result(value), explained.get(name)))
    for name, picture in (pictures or {}).items():
        body = _picture(name, picture, folder / "pictures")
        parts.append(_section(name, body, explained.get(name)))
    page = PAGE.format(
        title=html.escape(title),
        summary=f'<p class="summary">{html.escape(summary)}</p>' if summary else "",
        style=STYLE,
        body="\n".join(parts),
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "results.json", plain(results))
    with atomic_write(folder / "index.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
    return folder / "index.html"


PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
<header><h1>{title}</h1>{summary}</header>
{body}
</main>
</body>
</html>
"""


def plain(value: Any) -> Any:
    """Return results as values for JSON, undefined numbers as None.

    >>> plain({"share": Rate(0.5, 0.1, 0.9, 1, 2)})["share"]["count"]
    2
    """
    if hasattr(value, "as_dict"):
        return value.as_dict()
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (torch.Tensor, np.ndarray)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


def _is_headline(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number or isinstance(value, (Rate, Estimate, Difference))


def _headlines(values: Mapping[str, Any]) -> str:
    cards = []
    for name, value in values.items():
        number, detail = _split(format_cell(value))
        cards.append(
            f'<div class="card"><div class="name">{html.escape(name)}</div>'
            f'<div class="number">{html.escape(number)}</div>'
            f'<div class="detail">{html.escape(detail)}</div></div>'
        )
    return f'<div class="cards">{"".join(cards)}</div>'


def _split(text: str) -> tuple[str, str]:
    """Separate a number from its interval."""
    number, bracket, interval = text.partition(" [")
    return number, bracket.strip() + interval


def _section(name: str, body: str, note: str | None) -> str:
    explanation = f'<p class="note">{html.escape(note)}</p>' if note else ""
    return f"<section><h2>{html.escape(name)}</h2>{explanation}{body}</section>"


def _result(value: Any) -> str:
    if isinstance(value, Mapping):
        return _table([{"": name, "value": item} for name, item in value.items()], header=False)
    if isinstance(value, (list, tuple)) and value and all(isinstance(r, Mapping) for r in value):
        return _table(list(value))
    return f"<p>{html.escape(format_cell(value))}</p>"


def _table(rows: Sequence[Mapping[str, Any]], header: bool = True) -> str:
    names = columns_of(rows)
    head = "".join(f"<th>{html.escape(str(name))}</th>" for name in names)
    lines = []
    for row in rows:
        cells = "".join(_table_cell(row.get(name)) for name in names)
        lines.append(f"<tr>{cells}</tr>")
    top = f"<thead><tr>{head}</tr></thead>" if header else ""
    return f'<div class="wide"><table>{top}<tbody>{"".join(lines)}</tbody></table></div>'


def _table_cell(value: Any) -> str:
    number, detail = _split(format_cell(value)) if is_number(value) else (format_cell(value), "")
    kind = ' class="figure"' if is_number(value) else ""
    small = f' <span class="detail">{html.escape(detail)}</span>' if detail else ""
    return f"<td{kind}>{html.escape(number)}{small}</td>"


def _picture(name: str, picture: Picture, folder: Path) -> str:
    slug = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "picture"
    if isinstance(picture, Figure):
        light, dark = figure_png(picture), figure_png(picture, theme="dark")
        _keep(folder / f"{slug}.png", light)
        source = f'<source srcset="{_data(dark)}" media="(prefers-color-scheme: dark)">'
        width = round(picture.get_figwidth() * PIXELS_PER_INCH)
        image = f'<img src="{_data(light)}" alt="{html.escape(name)}" width="{width}">'
        return f'<div class="wide plot"><picture>{source}{image}</picture></div>'
    if isinstance(picture, (list, tuple)):
        if not picture:
            return "<p>None.</p>"
        _keep(folder / f"{slug}.png", gallery(picture))
        return f'<div class="cases">{"".join(_case(case) for case in picture)}</div>'
    content = _image_bytes(picture)  # type: ignore[arg-type]
    _keep(folder / f"{slug}.{_suffix(content)}", content)
    image = f'<img class="frames" src="{_data(content)}" alt="{html.escape(name)}">'
    return f'<div class="wide">{image}</div>'


def _case(case: Case) -> str:
    kind = "good" if case.good else "bad"
    source = _data(_png(case.picture))
    sentence = html.escape(case.sentence)
    return (
        f'<figure class="{kind}"><img src="{source}" alt="{sentence}">'
        f"<figcaption>{sentence}<br><strong>{html.escape(case.note)}</strong></figcaption></figure>"
    )


def _image_bytes(picture: bytes | str | Path | np.ndarray) -> bytes:
    if isinstance(picture, bytes):
        return picture
    if isinstance(picture, (str, Path)):
        try:
            return Path(picture).read_bytes()
        except OSError as error:
            raise UserError(f"cannot read the picture {picture}: {error.strerror}") from None
    return _png(picture)


def _png(pixels: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    upscaled(pixels, 192).save(buffer, format="PNG")
    return buffer.getvalue()


def _suffix(content: bytes) -> str:
    for start, suffix in SUFFIXES.items():
        if content.startswith(start):
            return suffix
    raise UserError("a picture must be a PNG, GIF or JPEG")


def _data(content: bytes) -> str:
    return f"data:image/{_suffix(content)};base64,{base64.b64encode(content).decode()}"


def _keep(path: Path, content: bytes) -> None:
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
