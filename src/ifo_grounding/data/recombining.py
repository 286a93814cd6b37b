"""New instructions made of the words of known ones."""

from __future__ import annotations

import itertools
from collections import defaultdict

import torch
from torch import Tensor


def recombined(pool: Tensor) -> Tensor:
    """Return instructions that are not in a pool and exchange one word between two that are.

    Two instructions that differ in two places, such as "go to the red circle" and "go to the blue
    square", make "go to the red square" and "go to the blue circle": no more is known of words than
    where they stand. An extension of the paper, for self-examination to practise what no
    demonstration names (docs/zero-shot.md).

    Args:
        pool: token ids, int64 [P, L], padded with 0 at the end.

    Returns:
        Token ids, int64 [Q, L], in order; empty where nothing new can be made.

    >>> recombined(torch.tensor([[1, 5, 7, 0], [1, 6, 8, 0], [2, 5, 7, 7]])).tolist()
    [[1, 5, 8, 0], [1, 6, 7, 0]]
    """
    rows = {tuple(row) for row in pool.tolist()}
    made = {
        (*row[:first], before, *row[first + 1 : second], after, *row[second + 1 :])
        for first, second in itertools.combinations(range(pool.shape[1]), 2)
        for row, pairs in _alike(rows, first, second).items()
        for before, after in itertools.product(*map(set, zip(*pairs, strict=True)))
    }
    return torch.tensor(sorted(made - rows), dtype=pool.dtype, device=pool.device).reshape(
        -1, pool.shape[1]
    )


def _alike(
    rows: set[tuple[int, ...]], first: int, second: int
) -> dict[tuple[int, ...], list[tuple[int, int]]]:
    """Group the words at two places by the rest of the instruction, where there are two words."""
    groups = defaultdict(list)
    for row in rows:
        if row[second]:
            rest = (*row[:first], 0, *row[first + 1 : second], 0, *row[second + 1 :])
            groups[rest].append((row[first], row[second]))
    return groups
