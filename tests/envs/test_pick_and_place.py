from __future__ import annotations

import copy
import pickle
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import (
    Compose,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    ToTensorImage,
    TransformedEnv,
    check_env_specs,
)
from torchrl.testing import rollout_consistency_assertion

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.keys import STOP
from ifo_grounding.tasks import (
    TASKS,
    VOCABULARY,
    Goal,
    Plan,
    Scene,
    SceneStream,
    expert,
    grammar,
)
from ifo_grounding.world import Layout, WorldState, render
from ifo_grounding.world.dynamics import PICK_PLACE
from reference import LETTERS, act, holds, plain, wishes

OBSERVED = {"pixels", "instruction", "done", "terminated", "truncated"}


def choose(env, td, actions) -> TensorDict:
    """Step, and return what came of it."""
    return env.step(td.set("action", torch.as_tensor(actions)))["next"]


def scenes(*numbers: int) -> TensorDict:
    return TensorDict({"scene": torch.tensor(numbers).unsqueeze(-1)}, batch_size=[len(numbers)])


def everything(td) -> dict:
    return dict(td.items(include_nested=True, leaves_only=True))


def assert_same(one, other) -> None:
    one, other = everything(one), everything(other)
    assert one.keys() == other.keys()
    assert all(torch.equal(one[key], other[key]) for key in one)


# --- specs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"num_envs": 256},
        {"instructed": False},
        {"expose_state": True},
        {"expose_state": True, "instructed": False},
        {"tile_size": 16},
        {"layout": Layout(size=3, objects=(2, 4), boxes=(2, 3)), "tile_size": 32},
        {"layout": Layout(size=10), "split": "zero-shot", "stream": "evaluation"},
        {"max_steps": 7, "split": "train", "holdout": "pairs-1", "holdout_visible": False},
    ],
)
def test_specs_hold_with_every_option(options):
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


# --- TorchRL's own machinery ---------------------------------------------------------------------


def test_inside_transforms():
    transforms = Compose(StepCounter(), RewardSum(), ToTensorImage(in_keys=["pixels"]))
    env = TransformedEnv(PickAndPlaceEnv("pick", num_envs=3, seed=0), transforms)
    check_env_specs(env, break_when_any_done="both")
    counts = env.rollout(100, break_when_any_done=False)["next", "step_count"]
    assert counts.max() <= 40


def test_inside_a_serial_env():
    env = SerialEnv(2, lambda: PickAndPlaceEnv("pick", num_envs=3))
    check_env_specs(env, break_when_any_done="both")
    env.set_seed(0)
    rollout = env.rollout(50, break_when_any_done=False)
    assert rollout.batch_size == torch.Size([2, 3, 50])
    # Each has a seed of its own.
    assert not torch.equal(rollout[0, 0, 0]["pixels"], rollout[1, 0, 0]["pixels"])


def test_inside_a_parallel_env():
    env = ParallelEnv(2, partial(PickAndPlaceEnv, "move", num_envs=3), mp_start_method="fork")
    try:
        check_env_specs(env, break_when_any_done="both")
        rollouts = []
        for _ in range(2):
            env.set_seed(5)
            torch.manual_seed(0)
            rollouts.append(env.rollout(20, break_when_any_done=False))
    finally:
        env.close()
    assert rollouts[0].batch_size == torch.Size([2, 3, 20])
    assert_same(*rollouts)


def test_rollouts_are_consistent_across_resets():
    rollout = PickAndPlaceEnv("pick", 8, seed=0).rollout(60, break_when_any_done=False)
    assert rollout["next", "done"].any()
    rollout_consistency_assertion(rollout, observation_key="pixels")
    rollout_consistency_assertion(rollout, observation_key="instruction")


# --- seeds and scenes ----------------------------------------------------------------------------


def seeded(seed: int, **options) -> TensorDict:
    env = PickAndPlaceEnv("pick-udlr", 6, seed=seed, **options)
    torch.manual_seed(0)
    return env.rollout(60, break_when_any_done=False)


def test_a_rollout_follows_from_its_seed():
    assert_same(seeded(3), seeded(3))
    assert not torch.equal(seeded(3)["pixels"], seeded(4)["pixels"])


def test_set_seed_starts_over():
    env = PickAndPlaceEnv("move", 3, seed=1)
    first = env.reset()
    env.reset()
    env.set_seed(1)
    assert_same(env.reset(), first)


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


def test_an_asked_scene_is_not_repeated_after_its_episode():
    env = PickAndPlaceEnv("move", 2, seed=0)
    td = env.reset(scenes(40, 41))
    policy = lambda td: td.set("action", torch.full((2,), STOP))  # noqa: E731
    env.rollout(3, policy, auto_reset=False, tensordict=td, break_when_any_done=False)
    # Two steps brought resets (the last step's end is left to the caller).
    assert env.scene_numbers.tolist() == [2, 3]


# --- episodes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_steps_and_rewards_agree_with_the_plain_rules(task):
    env = PickAndPlaceEnv(task, 32, seed=0, max_steps=20)
    td = env.reset()
    start = worlds = plain(env.truth.state)
    goals = list(wishes(grammar(task).parse_tokens(td["instruction"])))
    draw = torch.Generator().manual_seed(0)
    ends = 0
    for time in range(20):
        guess = torch.randint(6, (32,), generator=draw)
        known = expert.act(env.truth.state, env.truth.wanted, draw)
        actions = torch.where(torch.rand(32, generator=draw) < 0.1, guess, known)
        after = choose(env, td, actions)
        worlds = [act(w, LETTERS[a]) for w, a in zip(worlds, actions.tolist(), strict=True)]
        assert plain(env.truth.state) == worlds
        assert torch.equal(after["pixels"], render(env.truth.state))
        over = [a == STOP or time == 19 for a in actions.tolist()]
        rewards = [
            float(ended and holds(first, world, goal))
            for first, world, goal, ended in zip(start, worlds, goals, over, strict=True)
        ]
        assert after["reward"].squeeze(-1).tolist() == rewards
        assert after["done"].squeeze(-1).tolist() == over
        ends += sum(rewards)
        td = after.exclude("reward")
    assert ends > 16


@pytest.mark.parametrize("late", [0, 1])
def test_success_is_judged_when_time_runs_out(late):
    """The last move of the expert comes as action 40, or one too late."""
    env = PickAndPlaceEnv("pick", 64, seed=0)
    td = env.reset()
    scene = env._simulator.stream.scenes(env.scene_numbers)
    idles = scene.state.objects[torch.arange(64), scene.state.arm] == 0  # P does nothing there
    assert idles.sum() > 30
    begins = 40 - (scene.wanted.steps - 1) + late
    for time in range(40):
        wise = expert.act(env.truth.state, scene.wanted)
        after = choose(env, td, torch.where(time < begins, PICK_PLACE, wise))
        td = after.exclude("reward")
        assert bool(after["truncated"].all()) == (time == 39)
        assert not after["terminated"].any()
        assert time == 39 or not after["reward"].any()
    assert after["done"].all()
    assert (after["reward"].squeeze(-1)[idles] == 1 - late).all()


def test_a_stop_as_the_last_action_terminates():
    env = PickAndPlaceEnv("move", 4, seed=0, max_steps=3)
    td = env.reset()
    for action in (PICK_PLACE, PICK_PLACE, STOP):
        td = choose(env, td, torch.full((4,), action)).exclude("reward")
    assert td["terminated"].all()
    assert not td["truncated"].any()


def test_the_paper_s_limit_is_the_default():
    env = PickAndPlaceEnv("move", 2, seed=0)
    walk = lambda td: td.set("action", torch.zeros(2, dtype=torch.int64))  # noqa: E731
    rollout = env.rollout(100, walk)
    assert rollout.shape == (2, 40)
    assert rollout["next", "truncated"][:, -1].all()
    assert not rollout["next", "done"][:, :-1].any()


def test_partial_resets_touch_only_their_rows():
    env = PickAndPlaceEnv("pick", 6, seed=0, expose_state=True)
    td = env.reset()
    for _ in range(5):
        td = choose(env, td, torch.randint(5, (6,))).exclude("reward")
    steps = env._simulator.steps.clone()
    mask = torch.tensor([0, 1, 0, 0, 1, 1]).bool()
    before = td.clone()
    given = td.copy().set("_reset", mask.unsqueeze(-1))
    after = env.reset(given, set_state=False)
    assert after is given  # as EnvBase does
    assert torch.equal(td["pixels"], before["pixels"])  # the images given stay as they were
    for key, value in everything(after.exclude("_reset")).items():
        old = before[key]
        assert torch.equal(value[~mask], old[~mask])
    changed = (after["pixels"] != before["pixels"]).flatten(1).any(1)
    assert torch.equal(changed, mask)
    assert torch.equal(env._simulator.steps, torch.where(mask, 0, steps))
    assert env.scene_numbers.tolist() == [0, 6, 2, 3, 7, 8]
    # The next step goes on from there in all rows.
    shown = choose(env, after, torch.full((6,), STOP))
    assert torch.equal(shown["pixels"], after["pixels"])


@pytest.mark.parametrize("foreign", [False, True])
@pytest.mark.parametrize("instructed", [False, True])
def test_partial_resets_of_many_worlds_show_what_is_there(instructed, foreign):
    """So many that only what changed is drawn; with entries of others, as EnvBase resets them."""
    env = PickAndPlaceEnv("pick", 256, seed=0, instructed=instructed)
    td = env.reset()
    for turn in range(8):
        actions = 1 + torch.randint(5, (256,))
        running = choose(env, td, actions).exclude("reward").set("action", actions)
        assert torch.equal(running["pixels"], render(env._simulator.state))
        numbers, mask = env.scene_numbers.clone(), torch.rand(256) < 0.2
        given = running.clone().set("_reset", mask.unsqueeze(-1))
        if foreign:
            given["logits"] = torch.full((256, 6), torch.inf)
            given["collector", "number"] = torch.arange(1, 257)
        td = env.reset(given)
        assert torch.equal(td["pixels"], render(env._simulator.state))
        assert torch.equal(td["done"], running["done"] & ~mask.unsqueeze(-1))
        assert torch.equal(td["action"], actions * ~mask)
        assert torch.equal(env.scene_numbers != numbers, mask)
        assert "_reset" not in td
        if foreign:
            assert torch.equal(td["logits"] == 0, mask.unsqueeze(-1).expand(-1, 6))
            assert torch.equal(td["collector", "number"], torch.arange(1, 257) * ~mask)
        if instructed:
            began = env._simulator.stream.scenes(env.scene_numbers)
            assert torch.equal(td["instruction"], began.instruction)
            assert torch.equal(env.truth.wanted.objects, began.wanted.objects)
        if turn % 2:  # twice, and a step, before anybody looks
            env._simulator.reset(mask.nonzero().squeeze(-1)[:3])
            env._simulator.step(torch.randint(5, (256,)))
            td.update(env._observe())
            assert torch.equal(td["pixels"], render(env._simulator.state))


def test_a_reset_of_no_row_changes_nothing():
    env = PickAndPlaceEnv("pick", 3, seed=0)
    td = env.reset()
    none = torch.zeros(3, 1, dtype=torch.bool)
    assert_same(env.reset(td.clone().set("_reset", none)).exclude("_reset"), td)
    assert env.scene_numbers.tolist() == [0, 1, 2]


def test_partial_resets_can_name_their_scenes():
    env = PickAndPlaceEnv("pick", 3, seed=0)
    td = env.reset().clone()
    td.update(
        {"scene": scenes(50, 51, 52)["scene"], "_reset": torch.tensor([[0], [1], [0]]).bool()}
    )
    env.reset(td)
    assert env.scene_numbers.tolist() == [0, 51, 2]


# --- one's own sentence --------------------------------------------------------------------------


def own(env, text, **more) -> TensorDict:
    """A reset to the scenes as they are, with another instruction."""
    tokens = VOCABULARY.encode(text).expand(env.num_envs, -1)
    scene = env.scene_numbers.unsqueeze(-1)
    return TensorDict({"scene": scene, "instruction": tokens, **more}, [env.num_envs])


def test_a_reset_takes_one_s_own_sentence():
    env = PickAndPlaceEnv("move", 64, seed=0)
    first = env.reset().clone()
    td = env.reset(own(env, "move to the red circle"))
    assert torch.equal(td["pixels"], first["pixels"])
    assert set(VOCABULARY.decode(td["instruction"])) == {"move to the red circle"}
    suits = env.truth.wanted.verdict == 0
    assert 5 < suits.sum() < 60
    paid = torch.zeros(64, 1)
    for _ in range(12):
        td = choose(env, td, expert.act(env.truth.state, env.truth.wanted))
        paid += td.pop("reward")
    assert (paid[suits] >= 1).all()
    with pytest.raises(UserError, match="'put it' is no sentence of move"):
        env.reset(own(env, "put it"))
    # What a past observation shows is no wish.
    past = own(env, "move to the red circle", pixels=td["pixels"])
    assert torch.equal(env.reset(past)["instruction"], first["instruction"])


def test_another_sentence_amid_an_episode_is_refused():
    env = PickAndPlaceEnv("move", 3, seed=0)
    td = env.reset().set("instruction", VOCABULARY.encode("move to the red circle").expand(3, -1))
    with pytest.raises(UserError, match=r"give it to reset\(\), in a TensorDict of 'scene'"):
        env.rollout(2, auto_reset=False, tensordict=td)


# --- without instructions, with the state --------------------------------------------------------


def test_without_instructions_there_is_no_goal_and_no_reward():
    env = PickAndPlaceEnv("move", 64, seed=0, instructed=False)
    rollout = env.rollout(60, break_when_any_done=False)
    assert "instruction" not in rollout
    assert "instruction" not in rollout["next"]
    assert rollout["next", "terminated"].any()
    assert not rollout["next", "reward"].any()


def test_a_learner_s_environment_hides_what_is_true():
    """Neither its attributes nor its specs hold a state; what it keeps to itself, no goal."""
    env = PickAndPlaceEnv("pick", 4, seed=0, instructed=False)
    env.rollout(3)
    names = {*vars(env), *vars(PickAndPlaceEnv)} - {"truth"}
    values = [getattr(env, name) for name in names if not name.startswith("_")]
    values += [v for value in values for v in getattr(value, "__dict__", {}).values()]
    assert not any(isinstance(v, WorldState | Scene | Plan | Goal | SceneStream) for v in values)
    for spec in (env.output_spec, env.input_spec):
        parts = {part for key in spec.keys(True, True) for part in key}
        assert not {"state", "objects", "instruction"} & parts
    with pytest.raises(UserError, match="keeps its true state to itself"):
        _ = env.truth
    for kept in (env, pickle.loads(pickle.dumps(env))):
        scenes = [kept._simulator.scene, kept._simulator.stream.scenes(torch.arange(50))]
        assert not any(s.instruction.any() or s.wanted.objects.any() for s in scenes)


def test_the_state_is_hidden():
    env = PickAndPlaceEnv("pick", 4, seed=0)
    keys = set(everything(env.rollout(5)))
    assert not any("state" in key or "scene" in key for key in keys)
    assert not list(env.state_spec.keys(True, True))
    with pytest.raises(NotImplementedError, match="set_state"):
        env.reset(env.reset(), set_state=True)


def test_the_exposed_state_is_what_the_pixels_show_all_along():
    """Also after resets: what was recorded earlier must not change under the reader."""
    env = PickAndPlaceEnv("pick", 8, seed=0, expose_state=True)
    rollout = env.rollout(80, break_when_any_done=False)
    assert rollout["next", "done"].sum() > 20
    for td in (rollout, rollout["next"]):
        state = WorldState(**td["state"].to_dict(), batch_size=td.batch_size)
        assert torch.equal(render(state), td["pixels"])


def test_an_episode_can_begin_in_a_given_state():
    env = PickAndPlaceEnv("pick-out", 5, seed=0, expose_state=True)
    first = env.reset().clone()
    later = env.reset()
    assert not torch.equal(first["pixels"], later["pixels"])
    again = env.reset(first.clone(), set_state=True)
    assert_same(again, first)
    assert env.scene_numbers.tolist() == [-1] * 5
    for _ in range(40):
        wise = expert.act(env.truth.state, env.truth.wanted)
        again = choose(env, again, wise).exclude("reward")
        if again["done"].all():
            break
    goals = grammar("pick-out").parse_tokens(first["instruction"])
    start = WorldState(**first["state"].to_dict(), batch_size=[5])
    ends = zip(plain(start), plain(env.truth.state), wishes(goals), strict=True)
    assert all(holds(*episode) for episode in ends)


def test_a_given_state_needs_no_instruction_where_there_are_none():
    env = PickAndPlaceEnv("pick", 5, seed=0, expose_state=True, instructed=False)
    first = env.reset().clone()
    env.reset()
    assert_same(env.reset(first.clone(), set_state=True), first)


def test_steps_begin_at_the_state_in_the_tensordict():
    env = PickAndPlaceEnv("move", 3, seed=0, expose_state=True)
    td = env.reset()
    td["state", "arm"] = torch.tensor([35, 0, 7])
    after = choose(env, td, torch.tensor([0, 1, 2]))
    assert after["state", "arm"].tolist() == [29, 1, 13]


# --- people --------------------------------------------------------------------------------------


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
        ({"num_envs": 2.0}, "num_envs must be a whole number, got 2.0"),
        ({"max_steps": 2.5}, "max_steps must be a whole number, got 2.5"),
        ({"tile_size": 9}, "unknown tile size 9: choose one of 8, 16, 32"),
        ({"split": "test"}, "unknown split 'test'"),
        ({"holdout": "x"}, "unknown holdout 'x': choose one of 'pairs-1'"),
        ({"stream": "x"}, "unknown stream 'x': choose one of 'training'"),
        ({"max_steps": 0}, "max_steps must be at least 1"),
    ],
)
def test_bad_arguments_are_refused(wrong, said):
    with pytest.raises(UserError, match=said):
        PickAndPlaceEnv(**wrong)


def test_bad_resets_are_refused():
    env = PickAndPlaceEnv("move", 2, seed=0, expose_state=True)
    with pytest.raises(UserError, match="start at 0"):
        env.reset(scenes(0, -1))
    with pytest.raises(UserError, match="needs a tensordict with a state"):
        env.reset(set_state=True)
    with pytest.raises(UserError, match="needs an instruction beside the state"):
        env.reset(env.reset().exclude("instruction"), set_state=True)


def moved(env):
    assert str(env.to("cpu:0")._simulator.device) == "cpu:0"
    return env


@pytest.mark.parametrize(
    "change", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env)), moved]
)
def test_a_copied_or_moved_env_goes_on(change):
    """Also where both run side by side, and what they are asked is judged."""
    actions = torch.randint(6, (40, 64), generator=torch.Generator().manual_seed(0))
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


@pytest.mark.parametrize(
    ("actions", "said"),
    [
        ([0, 6, 1], r"actions are 0\.\.5 here, got 0\.\.6"),
        ([-1, 0, 0], r"actions are 0\.\.5 here, got -1\.\.0"),
        ([0.0, 1.0, 2.0], "one integer for each of 3 worlds, got torch.float32"),
        ([[1], [2], [3]], r"got torch\.int64 of shape \[3, 1\]"),
    ],
)
def test_other_actions_are_refused(actions, said):
    env = PickAndPlaceEnv("move", num_envs=3, seed=0)
    with pytest.raises(UserError, match=said):
        env.step(env.reset().set("action", torch.tensor(actions)))


@pytest.mark.parametrize("num_envs", [4, 300])
@pytest.mark.parametrize("options", [{}, {"expose_state": True}, {"instructed": False}], ids=str)
def test_episodes_that_begin_in_inference_mode_go_on_outside(num_envs, options):
    def begin():
        torch.manual_seed(0)
        env = PickAndPlaceEnv("pick", num_envs=num_envs, seed=0, **options)
        return env, env.rollout(30, break_when_any_done=False)

    with torch.inference_mode():
        env, first = begin()
    plain, expected = begin()
    assert (first == expected).all()
    torch.manual_seed(1)
    rest = env.rollout(30, break_when_any_done=False)
    torch.manual_seed(1)
    assert (rest == plain.rollout(30, break_when_any_done=False)).all()


@pytest.fixture
def deterministic():
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.usefixtures("deterministic")
def test_many_worlds_run_with_deterministic_algorithms():
    env = PickAndPlaceEnv("pick", num_envs=300, seed=0)
    rollout = env.rollout(8, break_when_any_done=False)
    assert torch.equal(rollout["next", "pixels"][:, -1], env._simulator.pixels(tile_size=8))


def test_scene_numbers_that_were_read_stay_what_they_were():
    env = PickAndPlaceEnv("move", num_envs=2, seed=0)
    env.reset()
    noted = env.scene_numbers
    env.reset()
    assert noted.tolist() == [0, 1]


def test_scene_numbers_are_any_whole_numbers():
    env = PickAndPlaceEnv("move", num_envs=2, seed=0)
    env.reset()
    asked = torch.tensor([[5], [6]])
    with pytest.raises(UserError, match=r"asked for by integers, got torch\.float32"):
        env.reset(TensorDict({"scene": asked.float()}, [2]))
    assert env.scene_numbers.tolist() == [0, 1]
    first = env.reset(TensorDict({"scene": asked.int()}, [2]))
    assert env.scene_numbers.tolist() == [5, 6]
    assert (env.reset(TensorDict({"scene": asked}, [2])) == first).all()


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
