"""GoalReward: hand-computed pay at stops, at ends, on arrival."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv, check_env_specs

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.transforms import GoalReward
from transforms.counter_world import (
    STOP,
    CounterWorld,
    expert,
    goal_classifier,
    make,
    reward_model,
    shown,
)

SURE = torch.tensor(4.0).sigmoid()


def goal(stop_action=STOP, **options):
    return GoalReward(goal_classifier(), stop_action, **options)


def constantly(action):
    return lambda td: td.set("action", torch.full(td.batch_size, action))


@pytest.fixture(params=[torch.float32, torch.float64])
def default_dtype(request):
    torch.set_default_dtype(request.param)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("default_dtype")
def test_the_probability_is_paid_when_the_policy_stops():
    rollout = make(goal()).rollout(60, expert, break_when_any_done=False)
    paid, stops = rollout["next", "learned_reward"][..., 0], rollout["action"] == STOP
    assert stops.sum() > 30
    assert torch.allclose(paid, stops * SURE)


def test_the_classifier_sees_the_first_image_and_the_last():
    rollout = make(goal()).rollout(10, constantly(STOP), break_when_any_done=False)
    assert torch.allclose(rollout["next", "learned_reward"], 1 - SURE)


def test_episodes_that_are_cut_are_paid_nothing():
    env = make(goal(), world=CounterWorld((4,), max_steps=1))
    rollout = env.rollout(8, constantly(0), break_when_any_done=False)
    assert rollout["next", "truncated"].all()
    assert (rollout["next", "learned_reward"] == 0).all()


def test_termination_can_stand_for_the_stop():
    rollout = make(goal(None)).rollout(40, expert, break_when_any_done=False)
    paid, terminated = rollout["next", "learned_reward"], rollout["next", "terminated"]
    assert torch.allclose(paid, terminated * SURE)


def test_on_arrival_the_episode_ends():
    env = make(goal(None, arrival=0.9))
    check_env_specs(env)
    after = env.rollout(60, constantly(0), break_when_any_done=False)["next"]
    reached = shown(after["pixels"]) == after["instruction"][..., 0] - 1
    assert reached.any() and not reached.all()
    assert torch.equal(after["terminated"][..., 0], reached)
    assert (after["done"] >= after["terminated"]).all()
    assert torch.allclose(after["learned_reward"][..., 0], reached * SURE)


def test_only_stops_are_scored():
    sizes = []
    model = goal_classifier()
    model.module.register_forward_hook(lambda _, inputs, __: sizes.append(len(inputs[0])))
    rollout = make(GoalReward(model, STOP)).rollout(30, break_when_any_done=False)
    assert sum(sizes) == (rollout["action"] == STOP).sum()


def test_keys_may_be_other_ones():
    plain = make(goal()).rollout(30, expert, break_when_any_done=False)
    batch = plain.select("instruction", "initial_pixels").set("move", plain["action"])
    batch["next"] = plain["next"].select().set("camera", plain["next", "pixels"])
    reward = goal(in_keys=["initial_pixels", "camera", "instruction", "move"], out_keys=["goal"])
    assert torch.equal(reward(batch)["next", "goal"], plain["next", "learned_reward"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stop_action": -1}, "an action, from 0 on, got -1"),
        ({"stop_action": True}, "stop_action must be a whole number, got True"),
        ({"stop_action": "env"}, "stop_action must be a whole number, got 'env'"),
        ({"stop_action": None, "arrival": 1.5}, "above 0 and at most 1, got 1.5"),
        ({"arrival": 0.9}, "for worlds without a stop"),
    ],
)
def test_impossible_options(options, message):
    with pytest.raises(UserError, match=message):
        goal(**options)


def test_what_does_not_fit_is_refused():
    with pytest.raises(UserError, match="stop_action=99 is no action"):
        make(goal(99)).rollout(1)
    with pytest.raises(UserError, match=r"writes 'action_score'.* writes 'goal_score'"):
        GoalReward(reward_model(), STOP)
    unnamed = TensorDictModule(lambda camera: camera, ["camera"], ["goal_score"])
    with pytest.raises(UserError, match="the image after the step; this one reads"):
        GoalReward(unnamed, STOP)
    with pytest.raises(UserError, match=r"needs the entry 'initial_pixels'.*on the environment"):
        goal()(make().rollout(5))


def test_the_stop_is_that_of_the_environment():
    world = PickAndPlaceEnv("move", num_envs=2, seed=0)
    assert "learned_reward" in TransformedEnv(world, goal(world.stop_action)).full_reward_spec
    with pytest.raises(UserError, match=r"stop_action=4 does not end .* is 5"):
        TransformedEnv(world, goal(4)).full_reward_spec  # noqa: B018
