"""Frames with a caption below, side by side."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import font_manager
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from ifo_grounding.errors import UserError

PAPER, INK, FAINT = "#FFFFFF", "#1F2328", "#59636E"
GOOD, BAD, RUNNING = "#009E73", "#D55E00", "#B6BEC7"
"""Colours that stay apart for colour-blind readers; words say the same."""

BORDER, PADDING, TEXT_SIZE, LINE = 4, 8, 14, 19


class Cell(NamedTuple):
    """One captioned picture."""

    frame: np.ndarray
    """Pixels, uint8 [3, H, W]."""
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
    """Return a frame, uint8 [3, H, W], enlarged without blur to about ``width`` pixels.

    >>> upscaled(np.zeros((3, 48, 48), dtype=np.uint8), 200).size
    (192, 192)
    """
    pixels = np.asarray(frame)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[0] != 3:
        raise UserError(f"a frame is uint8 [3, H, W], got {pixels.dtype} {list(pixels.shape)}")
    picture = Image.fromarray(np.ascontiguousarray(pixels.transpose(1, 2, 0)))
    scale = max(1, width // picture.width)
    size = (scale * picture.width, scale * picture.height)
    return picture.resize(size, Image.Resampling.NEAREST)


def wrapped(text: str, width: int) -> list[str]:
    """Break a text into lines that fit into ``width`` pixels."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and font().getlength(longer) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


class Sheet:
    """Draws captioned pictures of one size in a grid.

    Args:
        captions: all captions that will be shown, for the height of the cells.
        columns: cells side by side.
        width: about how wide a picture is drawn, in pixels.
        titled: whether cells have titles.
        noted: whether cells have notes.
    """

    def __init__(
        self,
        captions: Sequence[str],
        *,
        columns: int,
        width: int = 200,
        titled: bool = False,
        noted: bool = True,
    ) -> None:
        self.columns = max(1, min(columns, len(captions)))
        self.width, self.titled, self.noted = width, titled, noted
        self.lines = max(len(wrapped(caption, width)) for caption in captions)

    def draw(self, cells: Sequence[Cell]) -> Image.Image:
        """Return the grid of cells."""
        drawn = [self._cell(cell) for cell in cells]
        wide, high = drawn[0].size
        rows = -(-len(drawn) // self.columns)
        size = (self.columns * (wide + PADDING) + PADDING, rows * (high + PADDING) + PADDING)
        sheet = Image.new("RGB", size, PAPER)
        for index, picture in enumerate(drawn):
            row, column = divmod(index, self.columns)
            sheet.paste(
                picture, (PADDING + column * (wide + PADDING), PADDING + row * (high + PADDING))
            )
        return sheet

    def _cell(self, cell: Cell) -> Image.Image:
        picture = upscaled(cell.frame, self.width)
        top = LINE if self.titled else 0
        wide = max(picture.width, self.width) + 2 * BORDER
        below = LINE * (self.lines + self.noted) + 6
        canvas = Image.new("RGB", (wide, top + picture.height + 2 * BORDER + below), PAPER)
        draw = ImageDraw.Draw(canvas)
        if self.titled:
            draw.text((0, 0), cell.title, FAINT, font(bold=True))
        edge = (0, top, picture.width + 2 * BORDER - 1, top + picture.height + 2 * BORDER - 1)
        draw.rectangle(edge, fill=cell.colour)
        canvas.paste(picture, (BORDER, top + BORDER))
        y = top + picture.height + 2 * BORDER + 4
        for line in wrapped(cell.caption, self.width):
            draw.text((0, y), line, INK, font())
            y += LINE
        if cell.note:
            draw.text((0, y), cell.note, cell.colour, font(bold=True))
        return canvas
