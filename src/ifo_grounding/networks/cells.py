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


@dataclass
class Groups:
    """The cells of each feature map, those that look alike counted instead of repeated."""

    cell: Tensor
    """Which distinct cell, int64 [N, J]."""
    number: Tensor
    """How many places show it, [N, J]; 0 where a map has fewer than J kinds of cells."""
    mean: Tensor
    """The mean of what else is known of these places, [N, J, D]."""

    def __getitem__(self, rows: Tensor | slice) -> Groups:
        """Return the groups of some feature maps."""
        return Groups(self.cell[rows], self.number[rows], self.mean[rows])

    def repeated(self, times: int) -> Groups:
        """Return each feature map's groups several times in a row."""
        parts = (self.cell, self.number, self.mean)
        return Groups(*(part.repeat_interleave(times, 0) for part in parts))


def group_cells(index: Tensor, known: Tensor) -> Groups:
    """Group the cells of feature maps that look alike.

    Args:
        index: which distinct cell lies in each cell, int64 [N, C].
        known: what else is known of each cell, such as its place, [C, D] or [N, C, D].

    >>> groups = group_cells(torch.tensor([[4, 7, 4], [5, 5, 5]]), torch.eye(3)[:, :2])
    >>> groups.cell.tolist(), groups.number.tolist()
    ([[4, 7], [5, 5]], [[2.0, 1.0], [3.0, 0.0]])
    >>> groups.mean[0].tolist()
    [[0.5, 0.0], [0.0, 1.0]]
    """
    cells, order = index.sort(1)
    begins = F.pad(cells[:, 1:] != cells[:, :-1], (1, 0), value=True)
    group = begins.cumsum(1) - 1
    kinds = int(group.max()) + 1 if group.numel() else 1
    cell = cells[:, :1].repeat(1, kinds).scatter_(1, group, cells)
    of = torch.empty_like(group).scatter_(1, order, group)  # the group of each cell
    member = F.one_hot(of, kinds).to(known.dtype)
    number = member.sum(1)
    mean = member.transpose(1, 2) @ known / number.clamp_min(1).unsqueeze(-1)
    return Groups(cell, number, mean)


@dataclass
class Kinds:
    """Scenes by the kinds of cells that they show."""

    features: Tensor
    """[N, F, C], as those of a feature map."""
    place: Tensor
    """The mean place of each kind, [N, C, 2]."""
    number: Tensor
    """How many cells are of each kind, [N, C]; 0 where a scene shows fewer than C."""

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self.features)

    def __getitem__(self, rows: Tensor | slice) -> Kinds:
        """Return some of the scenes."""
        return Kinds(self.features[rows], self.place[rows], self.number[rows])


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
    return Pairs(*distinct_pairs(cells, instructions.unsqueeze(1), n_cells, n_instructions))


def distinct_pairs(
    first: Tensor, second: Tensor, n_first: int, n_second: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the distinct pairs of two numbers.

    Args:
        first: numbers below ``n_first``, int64 [*B].
        second: numbers below ``n_second``, int64, broadcast to [*B].
        n_first: bound of the first.
        n_second: bound of the second.

    Returns:
        The first and the second number of each distinct pair, int64 [P] each, and which pair lies
        where, int64 [*B].

    >>> [part.tolist() for part in distinct_pairs(torch.tensor([3, 1, 3]), torch.tensor(2), 4, 3)]
    [[1, 3], [2, 2], [1, 0, 1]]
    """
    keys = first + second * n_first
    size = n_first * n_second
    if size <= ROOM:
        mark = keys.new_zeros(size)
        mark[keys.flatten()] = 1
        found = mark.nonzero().squeeze(1)
        mark[found] = torch.arange(len(found), device=keys.device)
        index = mark[keys]
    else:
        found, index = torch.unique(keys, return_inverse=True)
    return found % n_first, found // n_first, index


def look_up(table: Tensor, index: Tensor) -> Tensor:
    """Return rows of ``table`` [U, F]: [*index.shape, F]; its gradient is fast on a CPU."""
    if table.device.type != "cpu":
        return F.embedding(index, table)
    return table.index_select(0, index.flatten()).unflatten(0, index.shape)
