from collections import Counter

import pytest
import torch

from ifo_grounding.tasks import TASKS, SceneOptions, draw_scenes, grammar, plan
from ifo_grounding.tasks.expert import act
from ifo_grounding.world import Layout, WorldState, step
from ifo_grounding.world.dynamics import STOP
from reference import holds, plain, shortest, wishes


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    ("layout", "scenes", "longest"),
    [
        (Layout(size=3, objects=(2, 3), boxes=(2, 3), inside=0.7), 6, 40),
        (Layout(size=4, objects=(2, 3), boxes=(2, 2), inside=0.7), 3, 40),
        (Layout(), 5, 8),
    ],
)
def test_no_shorter_success_exists(task, layout, scenes, longest):
    """Breadth-first search over all that can be done, picking up others included."""
    drawn = draw_scenes(SceneOptions(task, layout=layout), 0, torch.arange(300))
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
    goal = grammar("move").parse("move to the red circle").expand(n)
    wanted, draw = plan(state, goal), torch.Generator().manual_seed(0)
    actions = []
    for _ in range(5):
        actions.append(act(state, wanted, draw))
        state = step(state, actions[-1])
    paths = Counter(map(tuple, torch.stack(actions, 1).tolist()))
    assert len(paths) == 6
    assert all(path[-1] == STOP for path in paths)
    assert all(abs(count - n / 6) < 5 * (n * 5 / 36) ** 0.5 for count in paths.values())
