"""What holds in every world, whatever its size and contents."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ifo_grounding.world import Layout, WorldState, random_layout, render, step
from ifo_grounding.world.dynamics import DOWN, LEFT, PICK_PLACE, RIGHT, STOP, UP
from reference import act, plain, worlds

law = settings(max_examples=40, deadline=None, derandomize=True)
ROWS = 16


@st.composite
def walked(draw) -> WorldState:
    """Worlds [16] of any size after a random walk that picks and places often."""
    size = draw(st.integers(3, 10))
    most = min(size * size - 3, 12)
    low = draw(st.integers(0, most))
    layout = Layout(
        size=size,
        objects=(low, draw(st.integers(low, most))),
        boxes=(0, draw(st.integers(0, 3))),
        inside=draw(st.floats(0, 1)),
    )
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    state = random_layout(ROWS, layout, generator=generator)
    for _ in range(draw(st.integers(0, 12))):
        actions = torch.randint(6, (ROWS,), generator=generator)
        state = step(state, torch.where(actions == STOP, PICK_PLACE, actions))
    return state


def take(state: WorldState, *actions: int) -> WorldState:
    for action in actions:
        state = step(state, torch.full((ROWS,), action))
    return state


def same(one: WorldState, other: WorldState) -> torch.Tensor:
    """Which rows are equal, bool [16]."""
    cells = (one.objects == other.objects) & (one.boxes == other.boxes)
    return cells.all(-1) & (one.arm == other.arm) & (one.held == other.held)


def turned(state: WorldState) -> WorldState:
    """The worlds turned clockwise by a quarter."""
    size = state.size

    def turn(cells: torch.Tensor) -> torch.Tensor:
        return cells.unflatten(-1, (size, size)).rot90(-1, (-2, -1)).flatten(-2)

    row, column = state.arm // size, state.arm % size
    return WorldState(
        arm=column * size + (size - 1 - row),
        held=state.held,
        objects=turn(state.objects),
        boxes=turn(state.boxes),
        batch_size=state.batch_size,
    )


@law
@given(walked(), st.integers(0, 5))
def test_the_world_is_the_same_in_every_direction(state, action):
    """Turning the world and the action gives the turned outcome."""
    quarter = {UP: RIGHT, RIGHT: DOWN, DOWN: LEFT, LEFT: UP}
    assert same(turned(take(state, action)), take(turned(state), quarter.get(action, action))).all()


@law
@given(walked())
def test_picking_and_placing_undo_each_other(state):
    assert same(take(state, PICK_PLACE, PICK_PLACE), state).all()


@law
@given(walked(), st.integers(0, 5))
def test_one_step_is_that_of_the_plain_rules(state, action):
    expected = [act(world, "URDLPS"[action]) for world in plain(state)]
    assert plain(take(state, action)) == expected
    assert same(worlds(expected), take(state, action)).all()


@law
@given(walked(), st.sampled_from([8, 16, 32]), st.integers(0, 5))
def test_pictures_differ_where_and_only_where_worlds_do(state, tile_size, action):
    after = take(state, action)
    alike = (render(after, tile_size) == render(state, tile_size)).flatten(1).all(-1)
    assert torch.equal(alike, same(after, state))
