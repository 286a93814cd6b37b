"""What holds for every goal in every scene."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ifo_grounding.seeding import Lots
from ifo_grounding.tasks import REASONS, TASKS, fulfilled, plan, verdict
from ifo_grounding.tasks.expert import act
from ifo_grounding.world import Layout, random_layout, step
from ifo_grounding.world.dynamics import STOP
from reference import draw_goal, holds, plain, verdict_of, wishes

law = settings(max_examples=40, deadline=None, derandomize=True)
ROWS = 16


@st.composite
def asked(draw):
    """Scenes [16], and goals [16] of one task, most of them unsuitable."""
    task, seed = draw(st.sampled_from(TASKS)), draw(st.integers(0, 2**31))
    size = draw(st.integers(3, 10))
    most = min(size * size - 4, 14)
    low = draw(st.integers(1, most))
    layout = Layout(size=size, objects=(low, draw(st.integers(low, most))), boxes=(0, 4))
    state = random_layout(Lots(seed, torch.arange(ROWS)), layout)
    return state, draw_goal(task, state, seed, present=draw(st.floats(0, 1)))


@law
@given(asked(), st.integers(1, 45))
def test_verdicts_are_those_of_the_plain_rules(asked, max_steps):
    state, goal = asked
    found = [REASONS[number] for number in verdict(state, goal, max_steps).tolist()]
    pairs = zip(plain(state), wishes(goal), strict=True)
    assert found == [verdict_of(world, wish, max_steps) for world, wish in pairs]


@law
@given(asked(), st.integers(0, 2**31), st.integers(0, 20))
def test_success_is_that_of_the_plain_rules(asked, seed, patience):
    """Of walks that the expert begins, in half of the scenes until it is done, and chance ends."""
    start, goal = asked
    wanted, state = plan(start, goal), start
    draw = torch.Generator().manual_seed(seed)
    slips = torch.rand(ROWS, generator=draw) < 0.5
    for time in range(25):
        chance = torch.randint(6, (ROWS,), generator=draw)
        state = step(state, torch.where(slips & (time >= patience), chance, act(state, wanted)))
        if time % 8 == 0:
            rows = zip(plain(start), plain(state), wishes(goal), strict=True)
            assert fulfilled(state, wanted).tolist() == [holds(*row) for row in rows]


@law
@given(asked())
def test_the_expert_achieves_every_suitable_goal_in_the_planned_number_of_steps(asked):
    start, goal = asked
    wanted, state = plan(start, goal), start
    fits = wanted.verdict == 0
    assert not (fits & fulfilled(start, wanted)).any()
    stopped = ~fits
    for time in range(1, 41):
        action = act(state, wanted)
        stops = (action == STOP) & ~stopped
        assert (wanted.steps[stops] == time).all()
        stopped |= stops
        state = step(state, torch.where(stopped, STOP, action))
        if stopped.all():
            break
    assert fulfilled(state, wanted)[fits].all()
