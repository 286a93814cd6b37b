from __future__ import annotations

from collections import Counter

import pytest
import torch

from ifo_grounding.tasks import TASKS, Goal, SceneOptions, SceneStream, achieved, grammar, plan
from ifo_grounding.tasks.expert import act
from ifo_grounding.world import Layout, WorldState, step
from ifo_grounding.world.dynamics import PICK_PLACE, STOP
from reference import holds, plain, shortest, wishes


def run(state, wanted, draw) -> tuple[torch.Tensor, WorldState]:
    """Actions [N, T] until every expert has stopped, and where that leaves the worlds."""
    actions, stopped = [], torch.zeros(len(state), dtype=torch.bool)
    while not stopped.all():
        action = torch.where(stopped, STOP, act(state, wanted, draw))
        state, stopped = step(state, action), stopped | (action == STOP)
        actions.append(action)
        assert len(actions) <= 41
    return torch.stack(actions, 1), state


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("size", [6, 10])
def test_the_expert_always_succeeds_in_the_planned_number_of_steps(task, size):
    stream = SceneStream(SceneOptions(task, layout=Layout(size=size)), seed=size)
    scenes = stream.scenes(torch.arange(800))
    actions, final = run(scenes.state, scenes.wanted, torch.Generator().manual_seed(0))
    goals = grammar(task).parse_tokens(scenes.instruction)
    assert achieved(scenes.state, final, goals).all()
    taken = (actions == STOP).long().argmax(1) + 1
    assert torch.equal(taken, scenes.wanted.steps)
    assert (taken <= 40).all()
    places = (actions == PICK_PLACE).sum(1)
    assert (places == (2 if task.startswith("pick") else 0)).all()


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    ("layout", "scenes", "longest"),
    [
        (Layout(size=3, objects=(2, 3), boxes=(2, 3), inside=0.7), 12, 40),
        (Layout(size=4, objects=(2, 3), boxes=(2, 2), inside=0.7), 4, 40),
        (Layout(), 5, 8),
    ],
)
def test_no_shorter_success_exists(task, layout, scenes, longest):
    """Breadth-first search over all that can be done, picking up others included."""
    drawn = SceneStream(SceneOptions(task, layout=layout), seed=0).scenes(torch.arange(300))
    drawn = drawn[drawn.wanted.steps <= longest][:scenes]
    assert len(drawn) == scenes
    goals = wishes(grammar(task).parse_tokens(drawn.instruction))
    for world, wish, steps in zip(
        plain(drawn.state), goals, drawn.wanted.steps.tolist(), strict=True
    ):
        fewest = shortest(world, lambda end, w=world, g=wish: holds(w, end, g), limit=steps)
        assert fewest == steps


def test_ties_are_broken_so_that_each_shortest_path_is_equally_likely():
    """From the corner to a cell two down and two right there are six paths."""
    n = 6000
    state = WorldState.empty(n)
    state.objects[:, 14] = 1
    columns = {
        name: torch.zeros(n, dtype=torch.int64) for name in ("reference", "source", "target")
    }
    goal = Goal(
        task=torch.zeros(n, dtype=torch.int64),
        object=torch.ones(n, dtype=torch.int64),
        side=torch.zeros(n, dtype=torch.int64),
        **columns,
        batch_size=[n],
    )
    actions, _ = run(state, plan(state, goal), torch.Generator().manual_seed(0))
    paths = Counter(map(tuple, actions.tolist()))
    assert len(paths) == 6
    assert all(path[-1] == STOP for path in paths)
    assert all(abs(count - n / 6) < 5 * (n * 5 / 36) ** 0.5 for count in paths.values())
