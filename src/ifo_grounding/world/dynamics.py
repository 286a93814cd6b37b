"""What actions do: ``step(state, action) -> state``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ifo_grounding.world.state import WorldState

UP, RIGHT, DOWN, LEFT, PICK_PLACE, STOP = range(6)


def neighbour(cell: Tensor, direction: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return the cell next to ``cell``, int64 [*B], or itself, and whether it lies on the grid.

    Directions are 0..3 for up, right, down, left, int64 [*B].
    """
    row, column = cell // size, cell % size
    row = row + (direction == DOWN).long() - (direction == UP).long()
    column = column + (direction == RIGHT).long() - (direction == LEFT).long()
    inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
    return torch.where(inside, row * size + column, cell), inside


def step(state: WorldState, action: Tensor) -> WorldState:
    """Apply one action to each world.

    Moves off the grid and picks or places with nothing to do leave a world unchanged, and so does
    stop. A cell holds one object at most: placing on an occupied cell does nothing.

    Args:
        state: worlds [*B].
        action: 0..5 for up, right, down, left, pick or place, stop; int64 [*B]. Others are refused
            by an ``IndexError``, or not at all.

    Returns:
        New worlds [*B]; the given ones stay as they were.

    >>> state = WorldState.empty(1, size=6)
    >>> step(state, torch.tensor([DOWN])).arm
    tensor([6])
    """
    arm, held, objects = state.arm, state.held, state.objects
    cells = objects.shape[-1]
    places = _destinations(cells, arm.device)
    arm = places.index_select(0, torch.add(arm, action, alpha=cells).flatten()).view(arm.shape)
    here = arm.unsqueeze(-1)
    under = objects.gather(-1, here).squeeze(-1)
    # What is held and what lies there change places, unless both are objects.
    reaches = (action == PICK_PLACE) & (torch.minimum(held, under) == 0)
    swapped = (held ^ under) * reaches
    return WorldState(
        arm=arm,
        held=held ^ swapped,
        objects=objects.scatter(-1, here, (under ^ swapped).unsqueeze(-1)),
        boxes=state.boxes,
        batch_size=state.batch_size,
    )


_DESTINATIONS: dict[tuple[int, torch.device], Tensor] = {}


def _destinations(cells: int, device: torch.device) -> Tensor:
    """Return the cell that each action leads to from each cell, int64 [6 * cells]."""
    if (cells, device) not in _DESTINATIONS:  # no lru_cache, which torch.compile would not heed
        every = torch.arange(cells, device=device)
        led = [
            neighbour(every, torch.full_like(every, action), math.isqrt(cells))[0]
            for action in range(STOP + 1)
        ]
        _DESTINATIONS[cells, device] = torch.cat(led)
    return _DESTINATIONS[cells, device]
