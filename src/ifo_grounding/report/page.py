"""A report as one page that needs nothing else: no network, no other files."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader
from matplotlib.figure import Figure

from ifo_grounding.errors import UserError
from ifo_grounding.files import atomic_write, write_json
from ifo_grounding.report.drawing import Captioned, gallery, png, upscaled
from ifo_grounding.report.tables import columns_of, format_cell, is_number
from ifo_grounding.report.theme import figure_png
from ifo_grounding.stats.results import plain

PIXELS_PER_INCH = 84
SUFFIXES = {b"\x89PNG": "png", b"GIF8": "gif", b"\xff\xd8\xff": "jpeg"}
Picture = Figure | bytes | Sequence[Captioned]
"""A matplotlib figure, the bytes of an image file, or frames with captions."""


def write_report(
    folder: str | Path,
    results: Mapping[str, Any],
    pictures: Mapping[str, Picture] | None = None,
    *,
    title: str = "Report",
    summary: str = "",
) -> Path:
    """Write a folder with ``index.html``, ``results.json`` and ``pictures/``.

    The first picture stands on top, then numbers; all else is folded away under its heading. The
    page holds everything itself, so that it can be moved or sent alone. It adapts to phones and to
    dark mode.

    Args:
        results: what was measured, by heading. A number or an interval
            (:class:`~ifo_grounding.stats.Rate` and its like) is shown large; a mapping becomes a
            table of two columns, a list of mappings a table with a column per key, a text a
            paragraph.
        pictures: by heading: matplotlib figures, the bytes of PNGs, GIFs or JPEGs, or lists of
            :class:`~ifo_grounding.report.Captioned`.

    Returns:
        Path of the page.

    >>> import tempfile
    >>> from ifo_grounding.stats import wilson
    >>> page = write_report(tempfile.mkdtemp(), {"Success": wilson(9, 10)})
    >>> page.name, sorted(path.name for path in page.parent.iterdir())
    ('index.html', ['index.html', 'results.json'])
    """
    folder, pictures = Path(folder), pictures or {}
    cards, tables, shown = [], [], []
    for name, value in results.items():
        if is_number(value) and value is not None and not isinstance(value, bool):
            cards.append({"name": name, **_cell(value)})
        else:
            tables.append({"name": name, **_result(value)})
    for number, (name, picture) in enumerate(pictures.items(), 1):
        file = "-".join([f"{number:02}", *re.findall("[a-z0-9]+", name.lower())])[:80]
        shown.append({"name": name, **_picture(picture, folder / "pictures" / file)})
    # Every text is escaped by the template: instructions and names come from users.
    loader = PackageLoader("ifo_grounding.report", "")
    pages = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    page = pages.get_template("page.html").render(
        title=title,
        summary=summary,
        first=shown[0] if shown else None,
        cards=cards,
        sections=[*shown[1:], *tables],
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "results.json", plain(results))
    with atomic_write(folder / "index.html") as temporary:
        temporary.write_text(page, encoding="utf-8", errors="replace")
    return folder / "index.html"


def _result(value: Any) -> dict[str, Any]:
    """Return what the template shows of a result: a table or a text."""
    if isinstance(value, Mapping):
        return {"rows": [[_cell(name), _cell(item)] for name, item in value.items()]}
    if isinstance(value, (list, tuple)) and value and all(isinstance(r, Mapping) for r in value):
        names = columns_of(value)
        rows = [[_cell(row.get(name)) for name in names] for row in value]
        return {"columns": names, "rows": rows}
    return {"text": format_cell(value)}


def _cell(value: Any) -> dict[str, Any]:
    """Return a value as text, a number's interval apart from it."""
    text = format_cell(value)
    if not is_number(value):
        return {"number": text}
    number, bracket, interval = text.partition(" [")
    return {"number": number, "detail": bracket.strip() + interval, "figure": True}


def _picture(picture: Picture, path: Path) -> dict[str, Any]:
    """Return what the template shows of a picture, and write it into a file without its ending."""
    if isinstance(picture, Figure):
        content = _kept(figure_png(picture), path)
        return {"plot": content, "width": round(picture.get_figwidth() * PIXELS_PER_INCH)}
    if isinstance(picture, bytes):
        return {"image": _kept(picture, path)}
    if not picture:
        return {"text": "None."}
    _kept(gallery(picture), path)
    return {"cases": [(case, _data(png(upscaled(case.frame, 192)))) for case in picture]}


def _suffix(content: bytes) -> str:
    for start, suffix in SUFFIXES.items():
        if content.startswith(start):
            return suffix
    raise UserError("a picture must be a PNG, GIF or JPEG")


def _data(content: bytes) -> str:
    return f"data:image/{_suffix(content)};base64,{base64.b64encode(content).decode()}"


def _kept(content: bytes, path: Path) -> str:
    """Write an image file, and return it as the page holds it."""
    with atomic_write(path.with_name(f"{path.name}.{_suffix(content)}")) as temporary:
        temporary.write_bytes(content)
    return _data(content)
