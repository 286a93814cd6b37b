"""Pictures put together from tiles, one 64-bit word (eight pixels of a row) at a time.

Gathering 64-bit words in the order of the picture is several times faster than gathering whole
tiles and permuting them afterwards.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor

from ifo_grounding.errors import UserError

PIXELS_PER_WORD = 8
MOST_TILES = 1 << 15
"""Their numbers are int16."""
CHUNK_BYTES = 4 << 20
"""Pixels that are laid at a time on a CPU: they fit its cache."""


def check_tiles(tiles: Any) -> None:
    """Refuse what are no tiles, uint8 [K, C, T, T]."""
    some = isinstance(tiles, Tensor) and tiles.ndim == 4 and tiles.dtype == torch.uint8
    if not some or tiles.shape[2] != tiles.shape[3] or tiles.shape[3] % PIXELS_PER_WORD:
        what = f"{tiles.dtype} {[*tiles.shape]}" if isinstance(tiles, Tensor) else tiles
        raise UserError(
            "tiles are uint8 [K, C, T, T] with T a multiple of 8, such as env.tiles of "
            f"PickAndPlaceEnv(codes=True), got {what}"
        )
    if len(tiles) > MOST_TILES:
        raise UserError(
            f"their numbers are int16: at most {MOST_TILES:,} tiles, got {len(tiles):,}"
        )


def as_words(pixels: Tensor) -> Tensor:
    """View bytes [..., W], W a multiple of 8, as int64 words [..., W / 8].

    They are copied where they do not lie in a row, or begin within a word of their memory.

    >>> as_words(torch.ones(11, dtype=torch.uint8)[3:]).tolist() == [0x0101010101010101]
    True
    """
    row = pixels.contiguous()
    if row.storage_offset() % PIXELS_PER_WORD:
        row = row.clone()
    return row.view(torch.int64)


def cut(pictures: Tensor, height: int, width: int) -> Tensor:
    """Cut pictures, [N, C, H, W], into tiles [N, H / height, W / width, C * height * width].

    >>> cut(torch.arange(4).view(1, 1, 2, 2), 1, 2).tolist()
    [[[[0, 1]], [[2, 3]]]]
    """
    tiles = pictures.unflatten(-1, (-1, width)).unflatten(-3, (-1, height))
    return tiles.permute(0, 2, 4, 1, 3, 5).flatten(3)


def assemble(table: Tensor, index: Tensor) -> Tensor:
    """Lay tiles side by side.

    Args:
        table: tiles as :func:`as_words`, int64 [N, C, T, W].
        index: which tile at which place, integer [*B, rows, columns].

    Returns:
        Pixels, uint8 [*B, C, rows * T, columns * T].

    >>> tiles = torch.arange(2, dtype=torch.uint8).view(2, 1, 1, 1).expand(2, 3, 8, 8)
    >>> assemble(as_words(tiles), torch.tensor([[0, 1]]))[0, 0].tolist()
    [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1]
    """
    channels, size, width = table.shape[1:]
    *batch, rows, columns = index.shape
    shape = (channels, rows * size, columns * width * PIXELS_PER_WORD)
    planes = table.permute(1, 2, 0, 3)  # a plane of all tiles for each row of pixels
    planes = planes.reshape(1, channels, 1, size, -1)
    pictures = index.reshape(-1, rows, columns)
    chunk = max(1, CHUNK_BYTES // max(1, math.prod(shape)))
    if index.device.type != "cpu" or len(pictures) <= chunk:
        return _laid(planes, pictures, width).view(*batch, *shape)
    pixels = torch.empty(len(pictures), *shape, dtype=torch.uint8)
    for into, some in zip(pixels.split(chunk), pictures.split(chunk), strict=True):
        into.copy_(_laid(planes, some, width).view_as(into))
    return pixels.view(*batch, *shape)


def _laid(planes: Tensor, index: Tensor, width: int) -> Tensor:
    """Gather the words of pictures [N, rows, columns], uint8 [N, C, rows, T, columns * T]."""
    places = index.long()[:, None, :, None]
    if width > 1:
        word = torch.arange(width, device=planes.device)
        places = (places.unsqueeze(-1) * width + word).flatten(-2)
    shape = (len(places), planes.shape[1], index.shape[1], planes.shape[3], places.shape[-1])
    return planes.expand(*shape[:4], -1).gather(4, places.expand(shape)).view(torch.uint8)


def lay(pixels: Tensor, table: Tensor, places: Tensor, tiles: Tensor) -> None:
    """Lay tiles at some places of pictures that :func:`assemble` made.

    Args:
        pixels: uint8 [N, C, rows * T, columns * T], written to.
        table: tiles as :func:`as_words`, int64 [K, C, T, W].
        places: where, each once: picture, row and column as one number, int64 [M].
        tiles: which, integer [M].

    >>> table = as_words(torch.arange(2, dtype=torch.uint8).view(2, 1, 1, 1).expand(2, 3, 8, 8))
    >>> pixels = assemble(table, torch.tensor([[[0, 0]]]))
    >>> lay(pixels, table, torch.tensor([1]), torch.tensor([1]))
    >>> pixels[0, 0, 0].tolist()
    [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1]
    """
    rows, columns = (side // table.shape[2] for side in pixels.shape[-2:])
    first, rest = _words_of_tiles(*table.shape[1:], rows, columns, str(pixels.device))
    picture = places.div(len(first), rounding_mode="floor")
    begin = first.index_select(0, places - picture * len(first))
    begin.add_(picture, alpha=len(first) * len(rest))
    drawn = table.flatten(1).index_select(0, tiles.long()).view(-1)
    index, words = (begin.unsqueeze(-1) + rest).view(-1), pixels.view(torch.int64).view(-1)
    if torch.are_deterministic_algorithms_enabled():  # put_ is none of them, and faster
        words.scatter_(0, index, drawn)
    else:
        words.put_(index, drawn)


@functools.cache
def _words_of_tiles(
    channels: int, size: int, width: int, rows: int, columns: int, device: str
) -> tuple[Tensor, Tensor]:
    """Return the first word of each place of a picture, and where a tile's words follow it."""
    words = torch.arange(channels * rows * size * columns * width, device=device)
    words = words.view(channels, rows, size, columns, width)
    return words[0, :, 0, :, 0].flatten(), words[:, 0, :, 0].flatten()
