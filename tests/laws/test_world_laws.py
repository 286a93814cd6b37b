"""What holds in every world, whatever its size and contents."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ifo_grounding.seeding import Lots
from ifo_grounding.world import Layout, WorldState, random_layout, step
from ifo_grounding.world.dynamics import PICK_PLACE, STOP
from reference import LETTERS, act, plain, worlds

ROWS = 16


@st.composite
def walked(draw) -> WorldState:
    """Worlds [16] of any size after a random walk that picks and places often."""
    size = draw(st.integers(3, 10))
    most = min(size * size - 3, 12)
    low = draw(st.integers(0, most))
    objects, boxes = (low, draw(st.integers(low, most))), (0, draw(st.integers(0, 3)))
    layout = Layout(size, objects, boxes, inside=draw(st.floats(0, 1)))
    seed = draw(st.integers(0, 2**31))
    generator = torch.Generator().manual_seed(seed)
    state = random_layout(Lots(seed, torch.arange(ROWS)), layout)
    for _ in range(draw(st.integers(0, 12))):
        actions = torch.randint(6, (ROWS,), generator=generator)
        state = step(state, torch.where(actions == STOP, PICK_PLACE, actions))
    return state


@settings(max_examples=60, deadline=None, derandomize=True)
@given(walked(), st.integers(0, 5))
def test_one_step_is_that_of_the_plain_rules(state, action):
    expected = [act(world, LETTERS[action]) for world in plain(state)]
    after = step(state, torch.full((ROWS,), action))
    assert plain(after) == expected
    assert (worlds(expected) == after).all()
