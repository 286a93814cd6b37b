"""The world and its tasks once more, written slowly and plainly: dicts and loops, no tensors.

Written from the rules alone, so that tests can compare. A world is a :class:`Plain`; cells are
(row, column); objects are names such as ``"red circle"``; boxes are colour names.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from ifo_grounding.tasks import TASKS, Goal
from ifo_grounding.world import WorldState

COLOURS = ["red", "yellow", "blue"]
SHAPES = ["circle", "rectangle", "diamond", "triangle"]
KINDS = [None] + [f"{colour} {shape}" for colour in COLOURS for shape in SHAPES]
BOXES = [None, "orange", "green", "purple", "pink", "brown", "gray", "cyan"]
SIDES = ["above", "right", "below", "left"]
MOVES = {"U": (-1, 0), "R": (0, 1), "D": (1, 0), "L": (0, -1)}
BESIDE = dict(zip(SIDES, MOVES.values(), strict=True))
LETTERS = "URDLPS"

Cell = tuple[int, int]


@dataclass(frozen=True)
class Plain:
    """One world."""

    size: int
    arm: Cell
    held: str | None
    objects: frozenset[tuple[Cell, str]]
    boxes: frozenset[tuple[Cell, str]]


@dataclass(frozen=True)
class Wish:
    """One goal, as its sentence mentions it."""

    task: str
    object: str
    reference: str | None = None
    source: str | None = None
    target: str | None = None
    side: str | None = None


def on_grid(cell: Cell, size: int) -> bool:
    return all(0 <= coordinate < size for coordinate in cell)


def act(world: Plain, letter: str) -> Plain:
    """What one action does."""
    arm, held, objects = world.arm, world.held, dict(world.objects)
    if letter in MOVES:
        there = (arm[0] + MOVES[letter][0], arm[1] + MOVES[letter][1])
        if on_grid(there, world.size):
            arm = there
    elif letter == "P":
        if held is None and arm in objects:
            held = objects.pop(arm)
        elif held is not None and arm not in objects:
            objects[arm] = held
            held = None
    return Plain(world.size, arm, held, frozenset(objects.items()), world.boxes)


class Unresolved(Exception):
    """A goal whose referents are not there as they have to be."""


def resolve(world: Plain, wish: Wish) -> tuple[Cell, Cell]:
    """Cell of the object and cell where the arm or the object has to end."""
    objects, boxes = dict(world.objects), dict(world.boxes)

    mentioned = []
    places = [cell for cell, kind in objects.items() if kind == wish.object]
    if wish.task == "pick-out":
        places = [cell for cell in places if boxes.get(cell) == wish.source]
    mentioned.append(places)
    anchors = places
    if wish.task == "pick-udlr":
        others = [(cell, kind) for cell, kind in objects.items() if cell not in places]
        anchors = [cell for cell, kind in others if kind == wish.reference]
        mentioned.append(anchors)
    if wish.task in ("pick", "pick-out"):
        anchors = [cell for cell, colour in boxes.items() if colour == wish.target]
        mentioned.append(anchors)
    if any(len(cells) == 0 for cells in mentioned):
        raise Unresolved("missing")
    if any(len(cells) > 1 for cells in mentioned):
        raise Unresolved("ambiguous")

    (place,), (destination,) = places, anchors
    if wish.task.endswith("udlr"):
        step = BESIDE[wish.side]
        destination = (destination[0] + step[0], destination[1] + step[1])
    if not on_grid(destination, world.size):
        raise Unresolved("out of bounds")
    in_the_way = destination in objects and destination != place
    if wish.task == "move-udlr":
        in_the_way = destination in objects
    if in_the_way and wish.task != "move":
        raise Unresolved("occupied")
    return place, destination


def carries(wish: Wish) -> bool:
    return wish.task.startswith("pick")


def holds(initial: Plain, final: Plain, wish: Wish) -> bool:
    """Whether an episode from ``initial`` to ``final`` fulfils the wish."""
    try:
        place, destination = resolve(initial, wish)
    except Unresolved:
        return False
    if final.held is not None:
        return False
    before, after = dict(initial.objects), dict(final.objects)
    if carries(wish):
        if after.get(destination) != before.pop(place):
            return False
        del after[destination]
        return before == after
    return final.arm == destination and before == after


def apart(one: Cell, other: Cell) -> int:
    return abs(one[0] - other[0]) + abs(one[1] - other[1])


def verdict_of(world: Plain, wish: Wish, max_steps: int = 40) -> str:
    """``suitable``, or the first reason why not."""
    try:
        place, destination = resolve(world, wish)
    except Unresolved as reason:
        return str(reason)
    if (place if carries(wish) else world.arm) == destination:
        return "already true"
    if carries(wish):
        needed = apart(world.arm, place) + 1 + apart(place, destination) + 1 + 1
    else:
        needed = apart(world.arm, destination) + 1
    return "unachievable" if needed > max_steps or world.held is not None else "suitable"


def shortest(world: Plain, succeeds: Callable[[Plain], bool], limit: int) -> int | None:
    """Fewest actions, the stop included, after which ``succeeds``; None above ``limit``."""
    seen, queue = {world}, deque([(world, 0)])
    while queue:
        here, depth = queue.popleft()
        if succeeds(here):
            return depth + 1
        if depth + 1 < limit:
            for letter in "URDLP":
                after = act(here, letter)
                if after not in seen:
                    seen.add(after)
                    queue.append((after, depth + 1))
    return None


def plain(state: WorldState) -> list[Plain]:
    """Translate a batch of worlds [N]."""
    size = state.size
    cell = [divmod(number, size) for number in range(size * size)]
    rows = zip(
        state.arm.tolist(),
        state.held.tolist(),
        state.objects.tolist(),
        state.boxes.tolist(),
        strict=True,
    )
    return [
        Plain(
            size,
            cell[arm],
            KINDS[held],
            frozenset((cell[i], KINDS[kind]) for i, kind in enumerate(objects) if kind),
            frozenset((cell[i], BOXES[box]) for i, box in enumerate(boxes) if box),
        )
        for arm, held, objects, boxes in rows
    ]


def worlds(plains: list[Plain]) -> WorldState:
    """Translate back, [N]."""
    size = plains[0].size
    state = WorldState.empty(len(plains), size)
    for row, world in enumerate(plains):
        state.arm[row] = world.arm[0] * size + world.arm[1]
        state.held[row] = KINDS.index(world.held)
        for (r, c), kind in world.objects:
            state.objects[row, r * size + c] = KINDS.index(kind)
        for (r, c), colour in world.boxes:
            state.boxes[row, r * size + c] = BOXES.index(colour)
    return state


def wishes(goal: Goal) -> Iterator[Wish]:
    """Translate a batch of goals [N]."""
    columns = [getattr(goal, name).tolist() for name in Wish.__dataclass_fields__]
    for task, item, reference, source, target, side in zip(*columns, strict=True):
        name = TASKS[task]
        yield Wish(
            name,
            KINDS[item],
            KINDS[reference],
            BOXES[source],
            BOXES[target],
            SIDES[side] if name.endswith("udlr") else None,
        )


def draw_goal(task: str, state: WorldState, seed: int, present: float = 0.6) -> Goal:
    """Draw goals [N] whose every mention is something in the scene with probability ``present``."""
    draw = torch.Generator().manual_seed(seed)
    batch = len(state)

    def mention(cells: torch.Tensor, highest: int) -> torch.Tensor:
        anything = torch.randint(1, highest + 1, (batch,), generator=draw)
        weight = (cells > 0) + 1e-9 * torch.ones(cells.shape)
        seen = cells.gather(1, weight.multinomial(1, generator=draw)).squeeze(1).long()
        use = (torch.rand(batch, generator=draw) < present) & (seen > 0)
        return torch.where(use, seen, anything)

    none = torch.zeros(batch, dtype=torch.int64)
    boxed = torch.where(state.boxes > 0, state.objects, 0)
    item = mention(boxed if task == "pick-out" else state.objects, 12)
    other = mention(state.objects, 12)
    source = mention(torch.where(state.objects == item[:, None], state.boxes, 0), 7)
    target = mention(state.boxes, 7)
    return Goal(
        task=torch.full((batch,), TASKS.index(task)),
        object=item,
        reference=torch.where(other == item, other % 12 + 1, other)
        if task == "pick-udlr"
        else none,
        source=source if task == "pick-out" else none,
        target=torch.where(target == source, target % 7 + 1, target)
        if task == "pick-out"
        else (target if task == "pick" else none),
        side=torch.randint(4, (batch,), generator=draw) if task.endswith("udlr") else none,
        batch_size=[batch],
    )
