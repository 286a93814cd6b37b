"""Frames with a caption below, side by side."""

from __future__ import annotations

import functools
import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import font_manager
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont, ImageOps

from ifo_grounding.errors import UserError
from ifo_grounding.report.theme import FAINT, INK, PAPER, RUNNING
from ifo_grounding.texts import one_line

BORDER, PADDING, TEXT_SIZE, LINE = 4, 8, 14, 19


class Captioned(NamedTuple):
    """A picture with its caption, such as a state with the instruction that was chosen for it."""

    frame: np.ndarray
    """Pixels, uint8 [C, H, W]."""
    caption: str
    """Sentence below the picture."""
    title: str = ""
    """A word above the picture."""
    note: str = ""
    """A word below the caption, in the colour of the border."""
    colour: str = RUNNING
    """Colour of border and note."""


@functools.cache
def font(bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return the font that matplotlib brings along, so that every machine draws the same."""
    weight = "bold" if bold else "normal"
    path = font_manager.findfont(font_manager.FontProperties(family="DejaVu Sans", weight=weight))
    return ImageFont.truetype(path, TEXT_SIZE)


def upscaled(frame: ArrayLike, width: int) -> Image.Image:
    """Return a frame, uint8 [C, H, W], enlarged without blur to about ``width`` pixels.

    >>> upscaled(np.zeros((3, 48, 48), dtype=np.uint8), 200).size
    (192, 192)
    """
    pixels = np.asarray(frame)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or not pixels.size:
        raise UserError(f"a frame is uint8 [C, H, W], got {pixels.dtype} {list(pixels.shape)}")
    picture = Image.fromarray(coloured(pixels))
    return ImageOps.scale(picture, max(1, width // picture.width), Image.Resampling.NEAREST)


def coloured(frame: np.ndarray) -> np.ndarray:
    """Return a frame, uint8 [C, H, W], in colours as people see it, [H, W, 3].

    Of stacked frames the last one is shown; of four channels the first three, the last being alpha;
    where channels are no colours, the last one is shown in grey.

    >>> coloured(np.zeros((12, 48, 40), dtype=np.uint8)).shape
    (48, 40, 3)
    """
    channels = len(frame)
    shown = frame[:3] if channels == 4 else frame[-3:] if channels % 3 == 0 else frame[-1:]
    return np.ascontiguousarray(np.broadcast_to(shown, (3, *frame.shape[1:])).transpose(1, 2, 0))


def wrapped(text: str, width: int) -> list[str]:
    """Break a text into lines that fit into ``width`` pixels."""
    lines = [""]
    for word in one_line(text).split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and font().getlength(longer) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def draw_sheet(cells: Sequence[Captioned], *, columns: int, width: int) -> Image.Image:
    """Draw captioned pictures of one size in a grid, each about ``width`` pixels wide.

    Cells with the same captions and titles make sheets of the same size.
    """
    columns = max(1, min(columns, len(cells)))
    lines = max(len(wrapped(cell.caption, width)) for cell in cells)
    titled, noted = (any(texts) for texts in zip(*((c.title, c.note) for c in cells), strict=True))
    drawn = [_draw_cell(cell, width, LINE * titled, LINE * (lines + noted) + 6) for cell in cells]
    wide, high = drawn[0].size
    rows = -(-len(drawn) // columns)
    size = (columns * (wide + PADDING) + PADDING, rows * (high + PADDING) + PADDING)
    sheet = Image.new("RGB", size, PAPER)
    for index, picture in enumerate(drawn):
        row, column = divmod(index, columns)
        place = (PADDING + column * (wide + PADDING), PADDING + row * (high + PADDING))
        sheet.paste(picture, place)
    return sheet


def gallery(cells: Sequence[Captioned], *, columns: int = 4, width: int = 200) -> bytes:
    """Return captioned pictures side by side as a PNG; arguments as :func:`draw_sheet`.

    >>> gallery([Captioned(np.zeros((3, 48, 48), dtype=np.uint8), "move to the red circle")])[1:4]
    b'PNG'
    """
    if not cells:
        raise UserError("a gallery needs at least one picture")
    return png(draw_sheet(cells, columns=columns, width=width))


def png(picture: Image.Image) -> bytes:
    """Return a picture as the bytes of a PNG."""
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    return buffer.getvalue()


def _draw_cell(cell: Captioned, width: int, above: int, below: int) -> Image.Image:
    """Draw one picture with pixels above it for the title, and below it for caption and note."""
    picture = ImageOps.expand(upscaled(cell.frame, width), BORDER, cell.colour)
    size = (max(picture.width, width + 2 * BORDER), above + picture.height + below)
    canvas = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(canvas)
    draw.text((0, 0), one_line(cell.title), FAINT, font(bold=True))
    canvas.paste(picture, (0, above))
    y = above + picture.height + 4
    for line in wrapped(cell.caption, width):
        draw.text((0, y), line, INK, font())
        y += LINE
    legible = FAINT if cell.colour == RUNNING else cell.colour
    draw.text((0, y), one_line(cell.note), legible, font(bold=True))
    return canvas
