"""Which rows of a table are the same: what repeats is then computed once."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor


def distinct_rows(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distinct rows of a table and, for each row, which of them it is.

    Rows are told apart by a 64-bit hash, which is verified; a collision falls back to comparing
    rows, which takes thirty times as long.

    Args:
        rows: int64 [M, W].

    Returns:
        Distinct rows, int64 [U, W], in no particular order, and an index, int64 [M].

    >>> rows, index = distinct_rows(torch.tensor([[1, 2], [3, 4], [1, 2]]))
    >>> rows[index].tolist()
    [[1, 2], [3, 4], [1, 2]]
    """
    values, index = torch.unique(hash_rows(rows), return_inverse=True)
    found = rows.index_select(0, places_of(index, len(values)))  # many times as fast as rows[...]
    if torch.equal(found.index_select(0, index), rows):
        return found, index
    return torch.unique(rows, dim=0, return_inverse=True)


def places_of(index: Tensor, count: int) -> Tensor:
    """Return a place in ``index``, int64 [M], at which each number below ``count`` stands."""
    places = torch.arange(len(index), device=index.device)
    return places.new_zeros(count).scatter_(0, index, places)


def words_of(entries: Tensor) -> Tensor:
    """View the bytes of each entry [N, ...] as int64 words [N, W], the last one filled up by 0."""
    flat = entries.flatten(1).contiguous().view(torch.uint8)
    return F.pad(flat, (0, -flat.shape[1] % 8)).view(torch.int64)


def distinct_entries(tables: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return a place of each distinct entry [N, ...] of tables side by side, and which it is.

    Returns:
        Places, int64 [U], and for each entry which of them holds the same, int64 [N].

    >>> places, which = distinct_entries([torch.tensor([[1.0], [3.0], [1.0]])])
    >>> (places[which] % 2).tolist()
    [0, 1, 0]
    """
    found, which = distinct_rows(torch.cat([words_of(table) for table in tables], 1))
    return places_of(which, len(found)), which


def hash_rows(rows: Tensor) -> Tensor:
    """Hash rows, int64 [M, W], to int64 [M]: a sum weighed by odd numbers, modulo 2^64."""
    mixed = rows >> 29
    mixed ^= rows
    mixed *= torch.from_numpy(_factors(rows.shape[1])).to(rows.device)
    return mixed.sum(-1)


@functools.cache
def _factors(count: int) -> np.ndarray:
    """Return odd 64-bit numbers without any pattern; a tensor could belong to someone's vmap."""
    return np.random.default_rng(0).integers(-(2**63), 2**63 - 1, count) | 1
