"""What every environment must do, whether the worlds are the project's own or a user's."""

from functools import partial

import pytest
import torch
from torchrl.envs import check_env_specs

from envs.dial import PRESS, dials
from envs.stepping import assert_same, choose, everything, scenes
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError

GRID = partial(PickAndPlaceEnv, "pick", seed=0)
KINDS = {
    "grid": partial(GRID, 6),
    "many": partial(GRID, 300),
    "stateful": partial(GRID, 6, expose_state=True),
    "in codes": partial(GRID, 300, codes=True),
    "without instructions": partial(GRID, 6, instructed=False),
    "dials": partial(dials, 6),
    "dials with a stop": partial(dials, 6, stop=PRESS),
    "dials without instructions": partial(dials, 6, instructed=False),
}


@pytest.fixture(params=KINDS)
def make(request):
    return KINDS[request.param]


def test_specs_hold(make):
    check_env_specs(make(), break_when_any_done="both")


def test_partial_resets_touch_only_their_rows(make):
    env = make()
    td = env.reset()
    numbers, rows = env.scene_numbers.clone(), torch.arange(len(td))
    for _ in range(5):
        td = choose(env, td, torch.randint(2, (len(td),))).exclude("reward")
    mask = (rows % 6 == 1) | (rows % 6 > 3)
    before, given = td.clone(), td.copy().set("_reset", mask.unsqueeze(-1))
    after = env.reset(given, set_state=False)
    assert torch.equal(td["pixels"], before["pixels"])  # the images given stay as they were
    for key, value in everything(after.exclude("_reset")).items():
        assert torch.equal(value[~mask], before[key][~mask])
    assert (after["pixels"] != before["pixels"]).flatten(1).any(1)[mask].any()
    expected = torch.where(mask, len(td) + mask.cumsum(0) - 1, numbers)
    assert torch.equal(env.scene_numbers, expected)
    # They can name their scenes, too.
    env.reset(after.update({"scene": scenes(*rows + 50)["scene"], "_reset": ~mask[:, None]}))
    assert torch.equal(env.scene_numbers, torch.where(mask, expected, rows + 50))


def test_episodes_that_begin_in_inference_mode_go_on_outside(make):
    def begin():
        torch.manual_seed(0)
        env = make()
        return env, env.rollout(8, break_when_any_done=False)

    with torch.inference_mode():
        env, first = begin()
    plain, expected = begin()
    assert_same(first, expected)
    torch.manual_seed(1)
    rest = env.rollout(8, break_when_any_done=False)
    torch.manual_seed(1)
    assert_same(rest, plain.rollout(8, break_when_any_done=False))


@pytest.mark.parametrize(
    ("actions", "said"),
    [
        ([0, 6], r"actions of this world hold 6: allowed are 0\.\.\d"),
        ([-1, 0], r"actions of this world hold -1: allowed are 0\.\.\d"),
        ([0.0, 1.0], "one integer for each of .* worlds, got torch.float32"),
        ([[1], [2]], r"got torch\.int64 of shape \[\d+, 1\]"),
    ],
)
def test_other_actions_are_refused(make, actions, said):
    env = make()
    td = env.reset()
    with pytest.raises(UserError, match=said):
        choose(env, td, torch.tensor(actions * (len(td) // 2)))


@pytest.mark.parametrize("kind", ["without instructions", "dials without instructions"])
def test_a_learner_sees_neither_reward_nor_instruction_nor_the_world_s_own_goal(kind):
    rollout = KINDS[kind]().rollout(60, break_when_any_done=False)
    assert "instruction" not in rollout and "instruction" not in rollout["next"]
    assert rollout["next", "done"].any() and not rollout["next", "reward"].any()
    # A press of the dial is not its stop here.
    assert rollout["next", "terminated"].any() == (kind == "without instructions")
