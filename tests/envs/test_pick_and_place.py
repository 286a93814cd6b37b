import copy
import pickle
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ParallelEnv, SerialEnv, check_env_specs

from envs.stepping import assert_same, scenes
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.keys import STOP
from ifo_grounding.mosaic import as_words, assemble
from ifo_grounding.tasks import VOCABULARY
from ifo_grounding.world import Layout, WorldState, render, tile_table

OBSERVED = {"pixels", "instruction", "done", "terminated", "truncated"}


@pytest.mark.parametrize(
    "options",
    [
        {"layout": Layout(size=3, objects=(2, 4), boxes=(2, 3)), "tile_size": 32},
        {"layout": Layout(size=10), "split": "zero-shot", "stream": "evaluation"},
    ],
)
def test_specs_hold_in_other_layouts(options):
    env = PickAndPlaceEnv("pick", **{"num_envs": 4, "seed": 0, **options})
    check_env_specs(env, break_when_any_done="both")
    assert env.batch_locked


def test_tensordicts_hold_what_the_interface_says():
    env = PickAndPlaceEnv("pick-out", num_envs=5, seed=0)
    td = env.reset()
    assert set(td.keys()) == OBSERVED
    after = env.rand_step(td)["next"]
    assert set(after.keys()) == {*OBSERVED, "reward"}
    assert (td["pixels"].shape, td["pixels"].dtype) == ((5, 3, 48, 48), torch.uint8)
    assert (td["instruction"].shape, td["instruction"].dtype) == ((5, 16), torch.int64)
    assert (after["reward"].shape, after["reward"].dtype) == ((5, 1), torch.float32)
    assert (after["done"].shape, after["done"].dtype) == ((5, 1), torch.bool)
    assert (td["action"].shape, td["action"].dtype) == ((5,), torch.int64)
    assert env.action_spec.space.n == 6


@pytest.mark.parametrize("kind", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")])
def test_inside_workers(kind):
    env = kind(2, partial(PickAndPlaceEnv, "move", num_envs=3))
    try:
        check_env_specs(env, break_when_any_done="both")
        rollouts = []
        for _ in range(2):
            env.set_seed(5)
            torch.manual_seed(0)
            rollouts.append(env.rollout(10, break_when_any_done=False))
    finally:
        env.close()
    assert rollouts[0].batch_size == torch.Size([2, 3, 10])
    assert_same(*rollouts)
    # Each has a seed of its own.
    assert not torch.equal(rollouts[0][0, 0, 0]["pixels"], rollouts[0][1, 0, 0]["pixels"])


def test_scenes_can_be_asked_for_by_number():
    env = PickAndPlaceEnv("pick", 3, seed=0)
    stream = torch.cat([env.reset().clone() for _ in range(4)])
    td = env.reset(scenes(7, 0, 7))
    assert env.scene_numbers.tolist() == [7, 0, 7]
    assert torch.equal(td["pixels"], stream["pixels"][[7, 0, 7]])
    assert torch.equal(td["instruction"], stream["instruction"][[7, 0, 7]])
    # Whoever asks does not use up the stream.
    env.reset()
    assert env.scene_numbers.tolist() == [12, 13, 14]
    asked = torch.tensor([[5], [6], [7]])
    with pytest.raises(UserError, match=r"asked for by integers, got torch\.float32"):
        env.reset(TensorDict({"scene": asked.float()}, [3]))
    with pytest.raises(UserError, match="start at 0"):
        env.reset(scenes(0, -1, 0))
    assert env.scene_numbers.tolist() == [12, 13, 14]
    first = env.reset(TensorDict({"scene": asked.int()}, [3]))
    assert env.scene_numbers.tolist() == [5, 6, 7]
    assert (env.reset(TensorDict({"scene": asked}, [3])) == first).all()


def test_an_asked_scene_is_not_repeated_after_its_episode():
    env = PickAndPlaceEnv("move", 2, seed=0)
    td = env.reset(scenes(40, 41))
    policy = lambda td: td.set("action", torch.full((2,), STOP))  # noqa: E731
    env.rollout(3, policy, auto_reset=False, tensordict=td, break_when_any_done=False)
    # Two steps brought resets (the last step's end is left to the caller).
    assert env.scene_numbers.tolist() == [2, 3]


def test_render_draws_every_world_large():
    env = PickAndPlaceEnv("pick", 3, seed=0)
    env.reset()
    frames = env.render()
    assert isinstance(frames, np.ndarray)
    assert (frames.shape, frames.dtype) == ((3, 192, 192, 3), np.uint8)
    expected = render(env.truth.state, 32).permute(0, 2, 3, 1).numpy()
    assert np.array_equal(frames, expected)
    assert env.render(tile_size=16).shape == (3, 96, 96, 3)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"task": "fly"}, "unknown task 'fly': choose one of 'move', 'move-udlr'"),
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"max_steps": 2.5}, "max_steps must be a whole number, got 2.5"),
        ({"max_steps": 10**30}, r"max_steps must be below 2\*\*63, got 1000"),
        ({"seed": 1.5}, "seed must be a whole number, got 1.5"),
        ({"instructed": "no"}, "instructed 'no': choose one of True, False"),
        ({"tile_size": 9}, "unknown tile size 9: choose one of 8, 16, 32"),
    ],
)
def test_bad_arguments_are_refused(wrong, said):
    with pytest.raises(UserError, match=said):
        PickAndPlaceEnv(**wrong).reset()


def moved(env):
    assert str(env.to("cpu:0")._simulator.device) == "cpu:0"
    return env


@pytest.mark.parametrize(
    "change", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env)), moved]
)
def test_a_copied_or_moved_env_goes_on(change):
    actions = torch.randint(6, (12, 64), generator=torch.Generator().manual_seed(0))
    env = PickAndPlaceEnv("pick", 64, seed=3)
    shown = env.reset()
    for action in actions:
        shown = env.step_and_maybe_reset(shown.set("action", action))[1]
    other = change(copy.deepcopy(env))
    ahead = shown.clone()
    for action in actions:
        step, shown = env.step_and_maybe_reset(shown.set("action", action))
        same, ahead = other.step_and_maybe_reset(ahead.set("action", action))
        assert (step == same).all()
        wanted = env.truth.wanted.clone(), other.truth.wanted.clone()
        assert (wanted[0] == wanted[1]).all()


def test_many_worlds_run_with_deterministic_algorithms():
    env = PickAndPlaceEnv("pick", num_envs=300, seed=0)
    torch.use_deterministic_algorithms(True)
    try:
        rollout = env.rollout(8, break_when_any_done=False)
    finally:
        torch.use_deterministic_algorithms(False)
    assert torch.equal(rollout["next", "pixels"][:, -1], render(env.truth.state))


def test_worlds_begin_as_they_are_arranged():
    env, learner = (PickAndPlaceEnv("move", 2, seed=0, instructed=on) for on in (True, False))
    state = WorldState.empty(2)
    state.objects[:, 1] = 1
    start = env.reset(TensorDict({"state": state}, [2]))
    assert torch.equal(start["pixels"], render(state))
    asked = VOCABULARY.encode(["move to the red circle"] * 2)
    env.reset(TensorDict({"state": state, "instruction": asked}, [2]))
    for action, paid in ((1, 0.0), (5, 1.0)):
        done = env.step(TensorDict({"action": torch.full([2], action)}, [2]))
        assert (done["next", "reward"] == paid).all()
    for name, value in (("arm", 36), ("objects", 13), ("boxes", 8)):
        wrong = {**state.to_dict(), name: torch.full_like(getattr(state, name), value)}
        with pytest.raises(UserError, match=f"{name} of a world holds {value}"):
            env.reset(TensorDict({"state": wrong}, [2]))
    with pytest.raises(UserError, match="objects of these worlds is"):
        env.reset(TensorDict({"state": WorldState.empty(2, size=3)}, [2]))
    first = learner.reset(TensorDict({"scene": torch.zeros(2, 1).long()}, [2]))
    again = TensorDict({"scene": torch.zeros(2, 1).long(), "state": state}, [2])
    assert torch.equal(learner.reset(again)["pixels"], first["pixels"])  # learners arrange nothing


@pytest.mark.parametrize("tile_size", [8, 16])
def test_codes_are_arbitrary_numbers_of_the_tiles_that_pixels_show(tile_size):
    seen, coded = (
        PickAndPlaceEnv("pick", 40, seed=0, tile_size=tile_size, codes=codes)
        for codes in (False, True)
    )
    assert seen.tiles is None
    shown = []
    for env in (seen, coded):
        torch.manual_seed(0)
        shown.append(env.rollout(9, break_when_any_done=False)["pixels"])
    frames, codes = shown
    assert codes.dtype == torch.int16 and codes.shape == (40, 9, 6, 6)
    assert torch.equal(assemble(as_words(coded.tiles), codes), frames)
    # Two numbers never stand for one picture, nor do they say in which order the world counts.
    assert len(coded.tiles.flatten(1).unique(dim=0)) == len(coded.tiles)
    assert (coded.tiles != tile_table(tile_size)).flatten(1).any(1).float().mean() > 0.99
    again = PickAndPlaceEnv("move", seed=1, tile_size=tile_size, codes=True)
    assert torch.equal(again.tiles, coded.tiles)


def test_who_steps_before_a_reset_is_told():
    env = PickAndPlaceEnv("move", num_envs=2, seed=0)
    with pytest.raises(UserError, match="reset the environment first"):
        env.step(TensorDict({"action": torch.zeros(2).long()}, [2]))
    with pytest.raises(UserError, match="reset the environment first"):
        env.render()


def test_rewards_are_float32_whatever_the_default():
    torch.set_default_dtype(torch.float64)
    try:
        check_env_specs(PickAndPlaceEnv("move", num_envs=2, seed=0))
    finally:
        torch.set_default_dtype(torch.float32)
