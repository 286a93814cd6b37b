"""Cells that look alike are computed once.

Where no cell of a feature map sees another, what is computed for a cell depends on its picture
alone, and worlds made of tiles show the same few pictures again and again. So each is computed once
and looked up wherever it is needed. The result is the same up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

ROOM = 1 << 22
"""Entries of the largest table in which pairs are marked; more pairs than that are sorted."""


@dataclass
class Kinds:
    """Scenes by the kinds of cells that they show."""

    features: Tensor
    """[N, F, C], as those of a feature map."""
    place: Tensor
    """The mean place of each kind, [N, C, 2]."""
    number: Tensor
    """How many cells are of each kind, [N, C]; 0 where a scene shows fewer than C."""

    def __getitem__(self, rows: Tensor | slice) -> Kinds:
        return Kinds(self.features[rows], self.place[rows], self.number[rows])


def group_cells(index: Tensor, known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Group the cells of feature maps that look alike.

    Args:
        index: which distinct cell lies in each cell, int64 [N, C].
        known: what else is known of each cell, such as its place, [N, C, D].

    Returns:
        Of each map's groups: which distinct cell, int64 [N, J]; in how many places it lies, [N, J],
        0 where a map has fewer groups; and the mean of what is known of these places, [N, J, D].
        J is the most groups of a map or, on a GPU, which would have to be waited for, C.

    >>> cell, number, mean = group_cells(torch.tensor([[4, 7, 4]]), torch.eye(3)[None, :, :2])
    >>> cell.tolist(), number.tolist(), mean.tolist()
    ([[4, 7]], [[2.0, 1.0]], [[[0.5, 0.0], [0.0, 1.0]]])
    """
    cells, order = index.sort(1)
    begins = F.pad(cells[:, 1:] != cells[:, :-1], (1, 0), value=True)
    group = begins.cumsum(1) - 1
    counted = group.numel() and not group.is_cuda
    kinds = int(group.max()) + 1 if counted else max(1, group.shape[1])
    cell = cells[:, :1].repeat(1, kinds).scatter_(1, group, cells)
    of = torch.empty_like(group).scatter_(1, order, group)  # the group of each cell
    member = (of.unsqueeze(2) == torch.arange(kinds, device=of.device)).to(known.dtype)
    number = member.sum(1)
    mean = member.transpose(1, 2) @ known / number.clamp_min(1).unsqueeze(-1)
    return cell, number, mean


def cell_places(grid: tuple[int, int]) -> Tensor:
    """Return the row and column of each cell in [-1, 1], [h * w, 2]; 0 along a side of one cell.

    >>> cell_places((1, 2)).tolist()
    [[0.0, -1.0], [0.0, 1.0]]
    """
    axes = [torch.linspace(-1, 1, length) if length > 1 else torch.zeros(1) for length in grid]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).flatten(0, 1)


def distinct_pairs(
    first: Tensor, second: Tensor, n_first: int, n_second: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Find the distinct pairs of two numbers.

    Args:
        first: numbers below ``n_first``, int64 [*B].
        second: numbers below ``n_second``, int64, broadcast to [*B].

    Returns:
        The two numbers of each distinct pair, int64 [P] each, and which pair lies where, [*B].

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
