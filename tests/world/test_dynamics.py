from __future__ import annotations

import pytest
import torch

from ifo_grounding.keys import ACTIONS, N_ACTIONS
from ifo_grounding.world import neighbour, random_layout, step
from ifo_grounding.world.dynamics import DOWN, LEFT, PICK_PLACE, RIGHT, STOP, UP
from reference import LETTERS, Plain, plain, worlds


def after(world: Plain, *actions: int) -> Plain:
    state = worlds([world])
    for action in actions:
        state = step(state, torch.tensor([action]))
    return plain(state)[0]


def world(arm, held=None, objects=(), size=6) -> Plain:
    return Plain(size, arm, held, frozenset(objects), frozenset({((0, 0), "green")}))


def test_actions_are_in_the_order_of_the_paper():
    assert "".join(ACTIONS) == LETTERS == "URDLPS"
    assert (UP, RIGHT, DOWN, LEFT, PICK_PLACE, STOP) == (0, 1, 2, 3, 4, 5)
    assert N_ACTIONS == 6


@pytest.mark.parametrize(
    ("action", "cell"), [(UP, (1, 3)), (RIGHT, (2, 4)), (DOWN, (3, 3)), (LEFT, (2, 2))]
)
def test_a_move_goes_to_the_next_cell(action, cell):
    assert after(world((2, 3)), action) == world(cell)


@pytest.mark.parametrize(
    ("action", "cell"), [(UP, (0, 4)), (RIGHT, (4, 5)), (DOWN, (5, 1)), (LEFT, (3, 0))]
)
def test_a_move_off_the_grid_changes_nothing(action, cell):
    assert after(world(cell), action) == world(cell)


RED, BLUE = "red circle", "blue diamond"


def test_pick_takes_what_lies_under_the_arm():
    before = world((1, 1), None, [((1, 1), RED), ((2, 2), BLUE)])
    assert after(before, PICK_PLACE) == world((1, 1), RED, [((2, 2), BLUE)])


def test_place_puts_the_object_down():
    assert after(world((0, 0), RED), PICK_PLACE) == world((0, 0), None, [((0, 0), RED)])


def test_place_on_an_occupied_cell_changes_nothing():
    before = world((2, 2), RED, [((2, 2), BLUE)])
    assert after(before, PICK_PLACE) == before


def test_the_arm_carries_an_object_over_another():
    before = world((3, 0), None, [((3, 0), RED), ((3, 1), BLUE)])
    assert after(before, PICK_PLACE, RIGHT) == world((3, 1), RED, [((3, 1), BLUE)])
    done = after(before, PICK_PLACE, RIGHT, RIGHT, PICK_PLACE)
    assert done == world((3, 2), None, [((3, 1), BLUE), ((3, 2), RED)])


def test_steps_of_any_batch_shape_are_steps_of_its_rows():
    draw = torch.Generator().manual_seed(0)
    state, actions = random_layout(12, generator=draw), torch.randint(6, (12,), generator=draw)
    together = step(state.reshape(3, 4), actions.reshape(3, 4))
    assert together.batch_size == torch.Size([3, 4])
    assert (together.reshape(12) == step(state, actions)).all()


def test_neighbours_at_a_corner():
    cell = torch.tensor([0, 0, 0, 0])
    cells, inside = neighbour(cell, torch.arange(4), 6)
    assert cells.tolist() == [0, 1, 6, 0]
    assert inside.tolist() == [False, True, True, False]
