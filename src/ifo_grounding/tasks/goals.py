"""What an instruction asks for, whether it suits a state, and whether it was fulfilled.

This is the oracle: evaluation uses it, learners never do.
"""

from __future__ import annotations

import torch
from tensordict import TensorClass
from torch import Tensor

from ifo_grounding.errors import check_choice
from ifo_grounding.world import WorldState, neighbour

TASKS = ("move", "move-udlr", "pick", "pick-out", "pick-udlr")
MOVE, MOVE_UDLR, PICK, PICK_OUT, PICK_UDLR = range(5)
SIDES = ("above", "right", "below", "left")
"""In the order of the actions up, right, down, left."""
REASONS = (
    "suitable",
    "missing",
    "ambiguous",
    "out of bounds",
    "occupied",
    "already true",
    "unachievable",
)
"""Verdicts of :func:`verdict`, by number; where several hold, the first counts."""
SUITABLE, MISSING, AMBIGUOUS, OUT_OF_BOUNDS, OCCUPIED, ALREADY_TRUE, UNACHIEVABLE = range(7)
MAX_STEPS = 40


def check_task(task: str) -> int:
    """Return the number of a task; an unknown name is a :class:`UserError`."""
    check_choice("task", task, TASKS)
    return TASKS.index(task)


class Goal(TensorClass):
    """A batch of goals; what a task does not mention is 0."""

    task: Tensor
    """Index into :data:`TASKS`, int64 [*B]."""
    object: Tensor
    """Kind of the object to go to or to carry, 1..12, int64 [*B]."""
    reference: Tensor
    """Kind of the object that pick-udlr places next to, int64 [*B]."""
    source: Tensor
    """Colour of the box that pick-out takes the object from, 1..7, int64 [*B]."""
    target: Tensor
    """Colour of the box that pick and pick-out put the object into, 1..7, int64 [*B]."""
    side: Tensor
    """Index into :data:`SIDES` for the udlr tasks, else 0, int64 [*B]."""

    @property
    def has_side(self) -> Tensor:
        """Whether the goal names a side, bool [*B]."""
        return (self.task == MOVE_UDLR) | (self.task == PICK_UDLR)

    @property
    def carries(self) -> Tensor:
        """Whether the object is to be carried, bool [*B]."""
        return self.task >= PICK


class Plan(TensorClass):
    """A goal with its referents resolved in the initial state."""

    verdict: Tensor
    """Index into :data:`REASONS`, int64 [*B]."""
    object_cell: Tensor
    """Where the object is, int64 [*B]."""
    destination: Tensor
    """Where the arm or the object has to end, int64 [*B]."""
    carries: Tensor
    """Whether the object is to be carried, bool [*B]."""
    objects: Tensor
    """Objects in each cell once the goal is fulfilled, uint8 [*B, C]."""
    steps: Tensor
    """Length of a shortest solution, the stop included, int64 [*B]."""


def plan(state: WorldState, goal: Goal, max_steps: int = MAX_STEPS) -> Plan:
    """Resolve what a goal refers to in an initial state, and say whether it suits."""
    from_box, to_box = goal.task == PICK_OUT, (goal.task == PICK) | (goal.task == PICK_OUT)
    beside_object = goal.task == PICK_UDLR
    is_object = _shows(state.objects, goal.object)
    is_object &= ~from_box.unsqueeze(-1) | _shows(state.boxes, goal.source)
    is_reference = _shows(state.objects, goal.reference) & ~is_object  # nothing beside itself
    is_anchor = torch.where(beside_object.unsqueeze(-1), is_reference, is_object)
    is_anchor = torch.where(to_box.unsqueeze(-1), _shows(state.boxes, goal.target), is_anchor)
    places, anchor = _first(is_object), _first(is_anchor)
    beside, inside = neighbour(anchor, goal.side, state.size)
    destination = torch.where(goal.has_side, beside, anchor)
    inside = inside | ~goal.has_side

    steps = _distance(state.arm, torch.where(goal.carries, places, destination), state.size) + 1
    steps = steps + goal.carries * (2 + _distance(places, destination, state.size))
    at_destination = state.objects.gather(-1, destination.unsqueeze(-1)).squeeze(-1)
    is_there = torch.where(goal.carries, places, state.arm) == destination
    found = torch.stack([is_object.sum(-1), is_anchor.sum(-1)])
    checks = (
        ((found == 0).any(0), MISSING),
        ((found > 1).any(0), AMBIGUOUS),
        (~inside, OUT_OF_BOUNDS),
        ((goal.task != MOVE) & (at_destination > 0) & ~(goal.carries & is_there), OCCUPIED),
        (is_there, ALREADY_TRUE),
        ((steps > max_steps) | (state.held > 0), UNACHIEVABLE),
    )
    verdict = torch.full_like(goal.task, SUITABLE)
    for fails, reason in reversed(checks):
        verdict = torch.where(fails, reason, verdict)

    moved = state.objects.scatter(-1, places.unsqueeze(-1), 0)
    moved = moved.scatter(-1, destination.unsqueeze(-1), goal.object.to(torch.uint8).unsqueeze(-1))
    return Plan(
        verdict=verdict,
        object_cell=places,
        destination=destination,
        carries=goal.carries,
        objects=torch.where(goal.carries.unsqueeze(-1), moved, state.objects),
        steps=steps,
        batch_size=goal.batch_size,
    )


def verdict(state: WorldState, goal: Goal, max_steps: int = MAX_STEPS) -> Tensor:
    """Say whether a goal suits an initial state: index into :data:`REASONS`, int64 [*B].

    A goal is suitable if all it mentions exists without ambiguity, its destination is on the grid
    and free, it is not true yet, and it can be reached within ``max_steps`` (paper, "Selected
    Instructions Suitability").
    """
    return plan(state, goal, max_steps).verdict


def fulfilled(final: WorldState, wanted: Plan) -> Tensor:
    """Say whether a final state fulfils a goal that was resolved in the initial one, bool [*B].

    The relation has to hold, the hand has to be empty, and every other object has to be where it
    began. A goal whose referents are missing, ambiguous, occupied or off the grid never is.
    """
    resolved = (wanted.verdict == SUITABLE) | (wanted.verdict >= ALREADY_TRUE)
    in_place = _equal(final.objects, wanted.objects)
    there = wanted.carries | (final.arm == wanted.destination)
    return resolved & in_place & there & (final.held == 0)


def _equal(left: Tensor, right: Tensor) -> Tensor:
    """Say which rows of bytes [*B, C] are equal, bool [*B]; four at a time where C allows."""
    if left.shape[-1] % 4 == 0:
        left, right = (each.contiguous().view(torch.int32) for each in (left, right))
    return (left == right).all(-1)


def _shows(cells: Tensor, wanted: Tensor) -> Tensor:
    """Return which cells [*B, C] show what is wanted [*B], nowhere if that is 0."""
    wanted = wanted.to(cells.dtype).unsqueeze(-1)
    return (cells == wanted) & (wanted > 0)


def _first(mask: Tensor) -> Tensor:
    """Return the first true cell of each row, 0 where there is none, int64 [*B]."""
    return mask.byte().argmax(-1)


def _distance(start: Tensor, end: Tensor, size: int) -> Tensor:
    return (start // size - end // size).abs() + (start % size - end % size).abs()
