import pytest
import torch

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import compare_endings, episode_endings, success_rate
from ifo_grounding.evaluation.endings import ENDINGS
from ifo_grounding.tasks import draw_scenes, grammar

U, R, D, L, P, S = range(6)
EPISODES = 40


class Scripted:
    """A policy that does, in each row, what a rule says at the start; play asks running rows."""

    def __init__(self, task, rule):
        env = PickAndPlaceEnv(task, EPISODES, seed=0, stream="evaluation")
        env.reset()
        scene = draw_scenes(*env._simulator.seeded, env.scene_numbers)
        goals = grammar(task).parse_tokens(scene.instruction)
        self.plans = [rule(scene[row], goals[row]) for row in range(EPISODES)]
        self.step = 0

    def __call__(self, td):
        actions = [plan[self.step] for plan in self.plans if len(plan) > self.step]
        self.step += 1
        return td.set("action", torch.tensor(actions))


def way(start, end):
    down, right = int(end) // 6 - int(start) // 6, int(end) % 6 - int(start) % 6
    return [D if down > 0 else U] * abs(down) + [R if right > 0 else L] * abs(right)


def stop(scene, goal):
    return [S]


def never_stop(scene, goal):
    return [U] * 40


def solve(scene, goal):
    start, item, end = scene.state.arm, scene.wanted.object_cell, scene.wanted.destination
    if not goal.carries:
        return [*way(start, end), S]
    return [*way(start, item), P, *way(item, end), P, S]


def solve_by_a_detour(scene, goal):
    return [*([D, U] if scene.state.arm < 6 else [U, D]), *solve(scene, goal)]


def other_cell(scene):
    """Return the first cell of another object."""
    objects = scene.state.objects.clone()
    objects[scene.wanted.object_cell] = 0
    return objects.bool().byte().argmax()


def carry_another(scene, goal):
    start, item = scene.state.arm, other_cell(scene)
    return [*way(start, item), P, S]


def drop_elsewhere(scene, goal):
    start, item = scene.state.arm, scene.wanted.object_cell
    taken = scene.state.objects.bool()
    taken[scene.wanted.destination] = True
    empty = taken.byte().argmin()
    return [*way(start, item), P, *way(item, empty), P, S]


def endings(task, rule, **options):
    return episode_endings(Scripted(task, rule), task, episodes=EPISODES, **options)


@pytest.mark.parametrize("task", ["move", "move-udlr", "pick", "pick-out", "pick-udlr"])
def test_solutions_are_successes_and_walking_on_is_being_stuck(task):
    assert endings(task, solve).counts["success"] == EPISODES
    counts = endings(task, never_stop).counts
    assert sum(counts.values()) == EPISODES
    # Walking on may end where the arm should be, which counts at the last step.
    assert counts["stuck"] + counts["success"] == EPISODES


@pytest.mark.parametrize("task", ["pick", "pick-out", "pick-udlr"])
def test_what_a_carrying_episode_did_instead(task):
    assert endings(task, stop).counts["nothing done"] == EPISODES
    assert endings(task, carry_another).counts["wrong object"] == EPISODES
    assert endings(task, drop_elsewhere).counts["wrong place"] == EPISODES


def test_scenes_and_successes_are_those_of_success_rate():
    found = endings("pick", solve)
    rate = success_rate(Scripted("pick", solve), "pick", episodes=EPISODES)
    assert found.scenes == rate.scenes
    assert (found.kind == ENDINGS.index("success")).equal(rate.outcomes)
    assert ((found.actions >= 0).sum(1)).equal(rate.lengths)


def test_changes_between_two_policies():
    direct, detour, halted = (endings("pick", rule) for rule in (solve, solve_by_a_detour, stop))
    changes = compare_endings(halted, direct)
    assert changes["gained"]["nothing done"] == EPISODES
    assert sum(changes["lost"].values()) == changes["other path"] == changes["same path"] == 0
    assert compare_endings(direct, halted)["lost"]["nothing done"] == EPISODES
    assert compare_endings(direct, detour)["other path"] == EPISODES
    assert compare_endings(direct, direct)["same path"] == EPISODES
    with pytest.raises(UserError, match="different scenes"):
        compare_endings(direct, endings("pick", stop, max_steps=60))
    with pytest.raises(UserError, match="different scenes"):
        compare_endings(direct, endings("move", stop))
