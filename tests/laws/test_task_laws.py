"""What holds for every goal in every scene."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ifo_grounding.tasks import (
    REASONS,
    TASKS,
    achieved,
    plan,
    verdict,
)
from ifo_grounding.tasks.expert import act
from ifo_grounding.world import Layout, random_layout, step
from ifo_grounding.world.dynamics import STOP
from reference import draw_goal, holds, plain, verdict_of, wishes

law = settings(max_examples=40, deadline=None, derandomize=True)
ROWS = 16
tasks = st.sampled_from(TASKS)


@st.composite
def asked(draw):
    """A task, scenes [16], and goals [16] of it, most of them unsuitable."""
    task, seed = draw(tasks), draw(st.integers(0, 2**31))
    size = draw(st.integers(3, 10))
    most = min(size * size - 4, 14)
    low = draw(st.integers(1, most))
    layout = Layout(size=size, objects=(low, draw(st.integers(low, most))), boxes=(0, 4))
    state = random_layout(ROWS, layout, generator=torch.Generator().manual_seed(seed))
    return task, state, draw_goal(task, state, seed, present=draw(st.floats(0, 1)))


@law
@given(asked(), st.integers(1, 45))
def test_verdicts_are_those_of_the_plain_rules(asked, max_steps):
    _, state, goal = asked
    found = [REASONS[number] for number in verdict(state, goal, max_steps).tolist()]
    pairs = zip(plain(state), wishes(goal), strict=True)
    assert found == [verdict_of(world, wish, max_steps) for world, wish in pairs]


@law
@given(asked())
def test_a_suitable_goal_is_not_achieved_yet_and_the_expert_achieves_it(asked):
    _, start, goal = asked
    wanted, state = plan(start, goal), start
    fits = wanted.verdict == 0
    assert not (fits & achieved(start, start, goal)).any()
    stopped = ~fits
    for time in range(1, 41):
        action = act(state, wanted)
        stops = (action == STOP) & ~stopped
        assert (wanted.steps[stops] == time).all()
        stopped |= stops
        state = step(state, torch.where(stopped, STOP, action))
        # On the way there is no success but at the end.
        assert torch.equal(achieved(start, state, goal) & fits, _there(start, state, goal) & fits)
        if stopped.all():
            break
    assert achieved(start, state, goal)[fits].all()


def _there(start, state, goal) -> torch.Tensor:
    rows = zip(plain(start), plain(state), wishes(goal), strict=True)
    return torch.tensor([holds(*row) for row in rows])


@law
@given(asked())
def test_the_plan_shortens_by_one_with_each_step_of_the_expert(asked):
    _, state, goal = asked
    wanted = plan(state, goal)
    fits = (wanted.verdict == 0) & ~wanted.carries
    after = step(state, act(state, wanted))
    assert (plan(after, goal).steps == wanted.steps - 1)[fits].all()
