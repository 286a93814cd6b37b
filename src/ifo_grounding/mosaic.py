"""Pictures put together from tiles, one 64-bit word (eight pixels of a row) at a time.

Selecting 64-bit words in the order of the picture is several times faster than gathering whole
tiles and permuting them afterwards.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ifo_grounding.errors import UserError

PIXELS_PER_WORD = 8


def words(tiles: Tensor) -> Tensor:
    """View tiles, uint8 [N, 3, T, T], as int64 words [N, 3, T, T / 8].

    Raises:
        UserError: where T is not a multiple of 8, or tiles are not uint8.
    """
    if tiles.dtype != torch.uint8 or tiles.ndim != 4:
        raise UserError(f"tiles must be uint8 [N, C, T, T], got {tiles.dtype} {list(tiles.shape)}")
    if tiles.shape[-1] % PIXELS_PER_WORD:
        raise UserError(f"tile size must be a multiple of 8, got {tiles.shape[-1]}")
    return tiles.contiguous().view(torch.int64)


def assemble(table: Tensor, index: Tensor) -> Tensor:
    """Lay tiles side by side.

    Args:
        table: tiles as :func:`words`, int64 [N, C, T, W].
        index: which tile at which place, integer [*B, rows, columns].

    Returns:
        Pixels, uint8 [*B, C, rows * T, columns * T].

    >>> tiles = torch.arange(2, dtype=torch.uint8).view(2, 1, 1, 1).expand(2, 3, 8, 8)
    >>> assemble(words(tiles), torch.tensor([[0, 1]]))[0, 0].tolist()
    [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1]
    """
    channels, size, width = table.shape[1:]
    *batch, rows, columns = index.shape
    # Where each word comes from: within its channel first, which sums over longer rows than all
    # axes at once, and with 32 bits where they suffice.
    kind = torch.int32 if table.numel() < 2**31 else torch.int64
    tile = index.reshape(-1, rows, 1, columns, 1).to(kind) * (channels * size * width)
    word = torch.arange(size * width, dtype=kind, device=table.device).view(size, 1, width)
    plane = torch.arange(channels, dtype=kind, device=table.device) * (size * width)
    source = (tile + word).flatten(1).unsqueeze(1) + plane.unsqueeze(1)
    pixels = table.flatten().index_select(0, source.flatten()).view(torch.uint8)
    return pixels.reshape(*batch, channels, rows * size, columns * size)
