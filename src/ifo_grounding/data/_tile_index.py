"""Numbers for distinct rows of words: a hash table that never mistakes one row for another."""

from __future__ import annotations

import torch
from torch import Tensor

from ifo_grounding.errors import UserError

MULTIPLIER = -7046029254386353131
LOW_HALF = 0xFFFFFFFF


def hash_rows(words: Tensor, salt: int) -> Tensor:
    """Mix each row of ``words``, int64 [M, K], into one number, int64 [M]."""
    mixed = torch.full((len(words),), (2 * salt + 1) * MULTIPLIER % (1 << 62), dtype=torch.int64)
    for column in words.t().contiguous():
        mixed ^= column
        mixed *= MULTIPLIER
        mixed ^= (mixed >> 32) & LOW_HALF
    return mixed


class TileIndex:
    """Distinct rows of words and their numbers.

    Rows are found by a sorted list of hashes and then compared word by word; where two different
    rows share a hash, all are hashed anew with another salt. So an answer is exact.

    Args:
        words: distinct rows, int64 [N, K].
    """

    def __init__(self, words: Tensor) -> None:
        self.words = words
        self._salt = -1
        self._rehash()

    def __len__(self) -> int:
        return len(self.words)

    def find(self, rows: Tensor) -> Tensor:
        """Return the numbers of ``rows`` [M, K], int64 [M]; a row not in the index is an error."""
        number, known = self._look_up(rows)
        if not known.all():
            raise UserError(
                f"{int((~known).sum())} tiles are not in the dictionary: "
                "fit the codec on these frames too, or use update"
            )
        return number

    def add(self, rows: Tensor) -> Tensor:
        """Return the numbers of ``rows`` [M, K], int64 [M], adding those that are new."""
        number, known = self._look_up(rows)
        while not known.all():
            # Rows that share a hash are equal or collide; of each hash one row is added, and the
            # next round of looking up tells the others apart.
            fresh = rows[~known]
            distinct, group = hash_rows(fresh, self._salt).unique(return_inverse=True)
            chosen = torch.empty_like(distinct)
            chosen[group] = torch.arange(len(fresh))
            self.words = torch.cat([self.words, fresh[chosen]])
            self._salt -= 1
            self._rehash()
            number, known = self._look_up(rows)
        return number

    def _look_up(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the number of each row and whether it is known."""
        if not len(self.words):
            return torch.zeros(len(rows)).long(), torch.zeros(len(rows), dtype=torch.bool)
        hashes = hash_rows(rows, self._salt)
        place = torch.searchsorted(self._hashes, hashes).clamp_(max=len(self._hashes) - 1)
        number = self._order[place]
        known = self._hashes[place] == hashes
        # Hashes of the index are pairwise different, so a row that differs from the one of its hash
        # is not in the index.
        known &= (self.words[number] == rows).all(-1)
        return number, known

    def _rehash(self) -> None:
        """Sort hashes of the rows, with the first salt under which they all differ."""
        for _ in range(8):
            self._salt += 1
            self._hashes, self._order = hash_rows(self.words, self._salt).sort()
            if not len(self.words) or (self._hashes[1:] != self._hashes[:-1]).all():
                return
        raise UserError("tiles are not distinct: give each tile once")
