"""Cells that look alike are computed once.

Where no cell of a feature map sees another, what is computed for a cell depends on its picture and
on the instruction alone. Worlds made of tiles show the same few pictures again and again: a batch
of 512 images of 36 cells holds some 300 different ones, and 4,000 different pairs of a picture and
an instruction instead of 18,000. So each is computed once and looked up wherever it is needed. The
result is the same up to rounding; images without repetition take the plain way.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

ROOM = 1 << 22
"""Entries of the largest table in which pairs are marked; more pairs than that are sorted."""


@dataclass
class Cells:
    """The cells of a batch of feature maps, each distinct one stored once."""

    features: Tensor
    """[U, F]"""
    index: Tensor
    """Which of them lies in each cell, int64 [N, h * w]."""

    def __len__(self) -> int:
        """Return the number of feature maps."""
        return len(self.index)

    def maps(self, height: int, width: int) -> Tensor:
        """Return the feature maps, [N, F, height, width], channels last in memory."""
        return look_up(self.features, self.index).unflatten(1, (height, width)).movedim(-1, 1)

    def __getitem__(self, rows: Tensor | slice) -> Cells:
        """Return the feature maps of some rows."""
        return Cells(self.features, self.index[rows])


@dataclass
class Pairs:
    """The distinct pairs of a cell and an instruction in a batch."""

    cell: Tensor
    """Which cell, int64 [P]."""
    instruction: Tensor
    """Which instruction, int64 [P]."""
    index: Tensor
    """Which pair lies in each cell of each row, int64 [R, h * w]."""

    def __len__(self) -> int:
        """Return the number of distinct pairs."""
        return len(self.cell)

    def __getitem__(self, some: slice) -> Pairs:
        """Return some of the pairs; where they lie stays numbered as it was."""
        return Pairs(self.cell[some], self.instruction[some], self.index)


def pair_up(cells: Tensor, instructions: Tensor, n_cells: int, n_instructions: int) -> Pairs:
    """Find the distinct pairs of a cell and an instruction.

    Args:
        cells: numbers of the cells of each row, int64 [R, h * w].
        instructions: number of the instruction of each row, int64 [R].
        n_cells: how many cells are numbered.
        n_instructions: how many instructions are numbered.

    >>> pairs = pair_up(torch.tensor([[0, 1, 0], [1, 1, 0]]), torch.tensor([2, 2]), 2, 3)
    >>> pairs.cell.tolist(), pairs.instruction.tolist(), pairs.index.tolist()
    ([0, 1], [2, 2], [[0, 1, 0], [1, 1, 0]])
    """
    keys = cells + (instructions * n_cells).unsqueeze(1)
    size = n_cells * n_instructions
    if size <= ROOM:
        mark = keys.new_zeros(size)
        mark[keys.flatten()] = 1
        found = mark.nonzero().squeeze(1)
        mark[found] = torch.arange(len(found), device=keys.device)
        index = mark[keys]
    else:
        found, index = torch.unique(keys, return_inverse=True)
    return Pairs(found % n_cells, found // n_cells, index)


def look_up(table: Tensor, index: Tensor) -> Tensor:
    """Return rows of ``table`` [U, F]: [*index.shape, F]; its gradient is fast on a CPU."""
    if table.device.type != "cpu":
        return F.embedding(index, table)
    return table.index_select(0, index.flatten()).unflatten(0, index.shape)


def hidden_from_python(tensor: Tensor) -> bool:
    """Whether ``torch.vmap`` or the compiler works on ``tensor``: no shape may depend on it."""
    return torch._C._functorch.is_batchedtensor(tensor) or torch.compiler.is_compiling()
