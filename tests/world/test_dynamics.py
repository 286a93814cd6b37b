import pytest
import torch

from ifo_grounding.seeding import Lots
from ifo_grounding.world import random_layout, step
from reference import LETTERS, Plain, plain, worlds

RED, BLUE = "red circle", "blue diamond"
NEAR, FAR = ((2, 3), RED), ((4, 4), BLUE)


def world(arm, held=None, *objects) -> Plain:
    return Plain(6, arm, held, frozenset(objects), frozenset({((0, 0), "green")}))


@pytest.mark.parametrize(
    ("before", "actions", "after"),
    [
        (world((2, 3)), "U", world((1, 3))),
        (world((2, 3)), "R", world((2, 4))),
        (world((2, 3)), "D", world((3, 3))),
        (world((2, 3)), "L", world((2, 2))),
        (world((0, 4)), "U", world((0, 4))),  # off the grid
        (world((4, 5)), "R", world((4, 5))),
        (world((5, 1)), "D", world((5, 1))),
        (world((3, 0)), "L", world((3, 0))),
        (world((2, 3), None, NEAR, FAR), "S", world((2, 3), None, NEAR, FAR)),
        (world((2, 3), None, NEAR, FAR), "P", world((2, 3), RED, FAR)),
        (world((2, 3), None, FAR), "P", world((2, 3), None, FAR)),  # nothing there
        (world((2, 3), RED), "P", world((2, 3), None, NEAR)),
        (world((4, 4), RED, FAR), "P", world((4, 4), RED, FAR)),  # not onto another
        # An object is carried over another.
        (world((4, 3), RED, FAR), "RRP", world((4, 5), None, FAR, ((4, 5), RED))),
    ],
)
def test_steps_by_hand(before, actions, after):
    state = worlds([before])
    for letter in actions:
        state = step(state, torch.tensor([LETTERS.index(letter)]))
    assert plain(state) == [after]


def test_steps_of_any_batch_shape_are_steps_of_its_rows():
    draw = torch.Generator().manual_seed(0)
    state, actions = (
        random_layout(Lots(0, torch.arange(12))),
        torch.randint(6, (12,), generator=draw),
    )
    together = step(state.reshape(3, 4), actions.reshape(3, 4))
    assert together.batch_size == torch.Size([3, 4])
    assert (together.reshape(12) == step(state, actions)).all()
