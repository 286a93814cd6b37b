"""Tiles as rows of 64-bit words: cutting them out of frames, and numbering the distinct ones."""

from __future__ import annotations

import torch
from torch import Tensor

from ifo_grounding import mosaic
from ifo_grounding.distinct import distinct_rows
from ifo_grounding.errors import UserError


def cut(frames: Tensor, tile_size: int) -> Tensor:
    """Cut frames, uint8 [F, C, H, W], into tiles as words, int64 [F * rows * columns, K]."""
    count, channels, height, width = frames.shape
    words = mosaic.as_words(frames)
    across = tile_size // mosaic.PIXELS_PER_WORD
    grid = (count, channels, height // tile_size, tile_size, width // tile_size, across)
    return words.view(grid).permute(0, 2, 4, 1, 3, 5).reshape(-1, channels * tile_size * across)


class TileIndex:
    """Distinct rows of words and their numbers, in the order in which they were added.

    Args:
        words: distinct rows, int64 [N, K].

    Raises:
        UserError: where a row comes twice.
    """

    def __init__(self, words: Tensor) -> None:
        self.words = words
        self._numbers = {row.tobytes(): number for number, row in enumerate(words.numpy())}
        if len(self._numbers) != len(words):
            raise UserError("tiles are not distinct: give each tile once")

    def __len__(self) -> int:
        return len(self.words)

    def add(self, rows: Tensor) -> Tensor:
        """Return the numbers of ``rows`` [M, K], int64 [M], adding those that are new."""
        distinct, index = distinct_rows(rows)
        known = len(self)
        numbers = torch.tensor(
            [
                self._numbers.setdefault(row.tobytes(), len(self._numbers))
                for row in distinct.numpy()
            ],
            dtype=torch.int64,
        )
        if len(self._numbers) > known:
            self.words = torch.cat([self.words, distinct[numbers >= known]])
        return numbers[index]
