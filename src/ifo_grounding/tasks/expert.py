"""A demonstrator that takes shortest paths."""

from __future__ import annotations

import torch
from torch import Tensor

from ifo_grounding.tasks.goals import Plan
from ifo_grounding.world import WorldState
from ifo_grounding.world.dynamics import DOWN, LEFT, PICK_PLACE, RIGHT, STOP, UP


def act(state: WorldState, wanted: Plan, generator: torch.Generator | None = None) -> Tensor:
    """Return the next action on a shortest path, uniformly among the shortest paths.

    Args:
        state: worlds on such a path [*B].
        wanted: the goals, resolved in the initial states, with suitable verdicts.
        generator: breaks the ties.

    Returns:
        Actions, int64 [*B]; stop once the goal is fulfilled.
    """
    size = state.size
    placed = (state.objects == wanted.objects).all(-1) & (state.held == 0)
    fetches = wanted.carries & ~placed & (state.held == 0)
    aim = torch.where(fetches, wanted.object_cell, wanted.destination)
    rows = aim // size - state.arm // size
    columns = aim % size - state.arm % size
    to_go = rows.abs() + columns.abs()
    # A row step with this probability makes each shortest path equally likely.
    draw = torch.empty_like(to_go, dtype=torch.float32).uniform_(generator=generator) * to_go
    vertical = torch.where(rows > 0, DOWN, UP)
    horizontal = torch.where(columns > 0, RIGHT, LEFT)
    action = torch.where(draw < rows.abs(), vertical, horizontal)
    act_here = torch.where(wanted.carries & ~placed, PICK_PLACE, STOP)
    done = placed & wanted.carries
    return torch.where((to_go == 0) | done, act_here, action)
