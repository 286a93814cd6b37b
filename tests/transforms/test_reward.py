"""LearnedReward: hand-computed pay, on environments, batches and buffers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, RewardSum, ToTensorImage, TransformedEnv

from ifo_grounding.errors import UserError
from ifo_grounding.transforms import InstructionSampler, LearnedReward
from ifo_grounding.transforms.reward import numbers
from transforms.counter_world import (
    POOL,
    STOP,
    CounterWorld,
    action_judge,
    classifier,
    goal_judge,
    shown,
)

RIGHT, WRONG = (torch.tensor(logit).sigmoid().item() for logit in (2.0, -1.0))
SURE = torch.tensor(4.0).sigmoid().item()


def make(reward, batch=(6,), world=None):
    sampler = InstructionSampler(classifier(), POOL)
    return TransformedEnv(world or CounterWorld(batch, max_steps=12), Compose(sampler, reward))


def goal_reward(**options):
    return LearnedReward(goal_judge(), kind="goal", stop_action=STOP, **options)


def both(**options):
    return LearnedReward(
        action_judge(), kind="both", goal_model=goal_judge(), stop_action=STOP, **options
    )


def expert(tensordict):
    gap = tensordict["instruction"][..., 0] - 1 - shown(tensordict["pixels"])
    return tensordict.set("action", torch.where(gap > 0, 0, torch.where(gap < 0, 1, STOP)))


def stopper(tensordict):
    return tensordict.set("action", torch.full(tensordict.batch_size, STOP))


def wanted(rollout):
    return expert(rollout.clone())["action"]


def test_action_judge_pays_every_step():
    rollout = make(LearnedReward(action_judge())).rollout(30, break_when_any_done=False)
    paid = rollout["next", "learned_reward"]
    assert paid.shape == (6, 30, 1) and paid.dtype == torch.float32
    right = wanted(rollout) == rollout["action"]
    assert right.any() and not right.all()
    assert torch.allclose(paid[..., 0], torch.where(right, RIGHT, WRONG))
    assert rollout.get("learned_reward", None) is None


@pytest.mark.parametrize(
    ("form", "right", "wrong"),
    [("probability", RIGHT, WRONG), ("centred", RIGHT - 0.5, WRONG - 0.5), ("log-odds", 2.0, -1.0)],
)
def test_forms(form, right, wrong):
    rollout = make(LearnedReward(action_judge(), form=form)).rollout(20, break_when_any_done=False)
    paid = rollout["next", "learned_reward"][..., 0]
    expected = torch.where(wanted(rollout) == rollout["action"], right, wrong)
    assert torch.allclose(paid, expected)


def test_the_true_reward_is_left_alone():
    def rollout(*transforms):
        torch.manual_seed(0)
        env = TransformedEnv(
            CounterWorld((6,)), Compose(InstructionSampler(classifier(), POOL), *transforms)
        )
        return env.rollout(20, break_when_any_done=False)

    plain, paid = rollout(), rollout(LearnedReward(action_judge()))
    assert torch.equal(plain["next", "reward"], paid["next", "reward"])
    assert torch.equal(plain["action"], paid["action"])


def test_goal_judge_pays_when_the_policy_stops():
    rollout = make(goal_reward()).rollout(60, expert, break_when_any_done=False)
    paid, stops = rollout["next", "learned_reward"][..., 0], rollout["action"] == STOP
    assert stops.sum() > 30
    assert torch.allclose(paid[stops], torch.tensor(SURE))
    assert (paid[~stops] == 0).all()


def test_goal_judge_sees_the_first_image_and_the_last():
    rollout = make(goal_reward()).rollout(10, stopper, break_when_any_done=False)
    assert torch.allclose(rollout["next", "learned_reward"], torch.tensor(1 - SURE))


def test_the_default_dtype_may_be_another():
    torch.set_default_dtype(torch.float64)
    try:
        paid = make(goal_reward()).rollout(30, expert, break_when_any_done=False)
    finally:
        torch.set_default_dtype(torch.float32)
    assert paid["next", "learned_reward"].dtype == torch.float32
    assert paid["next", "learned_reward"].max() > 0


def test_truncated_episodes_are_paid_nothing():
    reward = goal_reward()
    env = make(reward, world=CounterWorld((4,), max_steps=1))
    rollout = env.rollout(
        8, lambda td: td.set("action", torch.zeros(4).long()), break_when_any_done=False
    )
    assert rollout["next", "truncated"].all()
    assert (rollout["next", "learned_reward"] == 0).all()


def test_termination_can_stand_for_the_stop():
    by_flag = make(LearnedReward(goal_judge(), kind="goal", stop_action=None))
    rollout = by_flag.rollout(40, expert, break_when_any_done=False)
    paid, terminated = rollout["next", "learned_reward"], rollout["next", "terminated"]
    assert torch.allclose(paid, terminated * torch.tensor(SURE))


@pytest.mark.parametrize("number", [np.int64(STOP), torch.tensor(STOP)])
def test_a_stop_may_be_any_whole_number(number):
    reward = LearnedReward(goal_judge(), kind="goal", stop_action=number)
    assert type(reward.stop_action) is int and reward.stop_action == STOP


def test_one_hot_actions_are_understood():
    state = TensorDict({"pixels": torch.full((2, 3, 8, 8), 40, dtype=torch.uint8)}, [2])
    batch = state.clone().update({
        "initial_pixels": torch.zeros(2, 3, 8, 8, dtype=torch.uint8),
        "instruction": POOL[[2, 2]],
        "action": torch.tensor([[0, 0, 1], [1, 0, 0]]),
        "next": state,
    })  # fmt: skip
    paid = goal_reward()(batch)["next", "learned_reward"]
    assert paid.flatten().tolist() == pytest.approx([SURE, 0.0])
    judge = LearnedReward(action_judge())
    by_number = judge(batch.clone().update({"action": torch.tensor([2, 0])}))
    assert torch.equal(judge(batch)["next", "learned_reward"], by_number["next", "learned_reward"])


def test_initial_pixels_last_the_episode_and_begin_anew():
    rollout = make(goal_reward()).rollout(40, break_when_any_done=False)
    started = torch.ones(6, 40, dtype=torch.bool)
    started[:, 1:] = rollout["next", "done"][:, :-1, 0]
    first, now = rollout["initial_pixels"], rollout["pixels"]
    assert torch.equal(first[started], now[started])
    going = ~started[:, 1:]
    assert torch.equal(first[:, 1:][going], first[:, :-1][going])
    assert not torch.equal(first, now)
    assert torch.equal(rollout["next", "initial_pixels"], first)


def test_a_partial_reset_keeps_the_other_rows_first_image():
    env = make(goal_reward(), (4,))
    tensordict = env.rollout(3, lambda td: td.set("action", torch.zeros(4).long()))[:, -1]["next"]
    mask = torch.tensor([[True], [False], [False], [True]])
    after = env.reset(tensordict.exclude("reward", "learned_reward").set("_reset", mask.clone()))
    kept, begun = [1, 2], [0, 3]
    assert torch.equal(after["initial_pixels"][kept], tensordict["initial_pixels"][kept])
    assert torch.equal(after["initial_pixels"][begun], after["pixels"][begun])


def test_both_add_up_with_weights():
    rollout = make(both(weights=(0.5, 3.0), form="centred")).rollout(
        40, expert, break_when_any_done=False
    )
    stops = (rollout["action"] == STOP).float()
    expected = 0.5 * (RIGHT - 0.5) + 3.0 * SURE * stops
    assert torch.allclose(rollout["next", "learned_reward"][..., 0], expected)


@pytest.mark.parametrize("make_reward", [lambda: LearnedReward(action_judge()), goal_reward, both])
def test_relabelling_pays_what_the_environment_paid(make_reward):
    rollout = make(make_reward()).rollout(30, break_when_any_done=False)
    paid = rollout["next", "learned_reward"].clone()
    relabelled = make_reward()(rollout.clone().exclude(("next", "learned_reward")))
    assert torch.equal(relabelled["next", "learned_reward"], paid)
    flat = make_reward()(rollout.reshape(-1).exclude(("next", "learned_reward")))
    assert torch.equal(flat["next", "learned_reward"], paid.reshape(-1, 1))


def test_on_a_replay_buffer():
    rollout = make(goal_reward()).rollout(30, expert, break_when_any_done=False).reshape(-1)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(200), batch_size=64, transform=goal_reward()
    )
    buffer.extend(rollout.exclude(("next", "learned_reward")))
    sample = buffer.sample()
    stops = (sample["action"] == STOP).unsqueeze(-1)
    assert torch.allclose(sample["next", "learned_reward"], stops * torch.tensor(SURE))


def test_on_a_replay_buffer_the_stop_may_be_asked_of_the_environment():
    world = CounterWorld((6,), max_steps=12)
    world.stop_action = STOP
    reward = LearnedReward(goal_judge(), kind="goal")
    env = make(reward, world=world)
    rollout = env.rollout(30, expert, break_when_any_done=False).reshape(-1)

    def filled(transform):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(200), batch_size=64)
        buffer.append_transform(transform)
        buffer.extend(rollout.exclude(("next", "learned_reward")))
        return buffer

    sample = filled(LearnedReward(goal_judge(), kind="goal").ask(env)).sample()
    stops = (sample["action"] == STOP).unsqueeze(-1)
    assert torch.allclose(sample["next", "learned_reward"], stops * torch.tensor(SURE))
    with pytest.raises(UserError, match="a batch does not say which action is the stop"):
        filled(LearnedReward(goal_judge(), kind="goal")).sample()


def test_large_batches_are_scored_in_parts():
    sizes = []
    judge = TensorDictModule(
        lambda action: sizes.append(len(action)) or action.float().unsqueeze(-1), ["action"], ["x"]
    )
    batch = TensorDict({"action": torch.arange(10_000)}, [10_000])
    paid = LearnedReward(judge, form="log-odds")(batch)["next", "learned_reward"]
    assert torch.equal(paid[:, 0], torch.arange(10_000.0))
    assert sizes == [4096, 4096, 1808]


def test_only_stops_are_judged():
    sizes = []
    judge = goal_judge()
    judge.module.register_forward_hook(lambda _, inputs, __: sizes.append(len(inputs[0])))
    env = make(LearnedReward(judge, kind="goal", stop_action=STOP))
    rollout = env.rollout(30, break_when_any_done=False)
    assert sum(sizes) == (rollout["action"] == STOP).sum()


def test_mode_of_the_judges_is_left_alone():
    first, second = action_judge().train(), goal_judge().train()
    second.module.dropout.eval()
    reward = LearnedReward(first, kind="both", goal_model=second, stop_action=STOP)
    rollout = make(reward).rollout(30, expert, break_when_any_done=False)
    stops = (rollout["action"] == STOP).float()
    assert torch.allclose(rollout["next", "learned_reward"][..., 0], RIGHT + SURE * stops)
    assert first.training and first.module.dropout.training
    assert second.training and not second.module.dropout.training
    assert not rollout["next", "learned_reward"].requires_grad


def test_trained_weights_are_used_at_once():
    judge = action_judge()
    env = make(LearnedReward(judge, form="log-odds"))
    with torch.no_grad():
        judge.module.right.fill_(7.0)
    assert (env.rollout(5, expert)["next", "learned_reward"] == 7).all()


def test_order_of_the_transforms_does_not_matter():
    torch.manual_seed(0)
    world = CounterWorld((6,))
    env = TransformedEnv(world, Compose(both(), InstructionSampler(classifier(), POOL)))
    rollout = env.rollout(30, expert, break_when_any_done=False)
    stops = (rollout["action"] == STOP).float()
    assert torch.allclose(rollout["next", "learned_reward"][..., 0], RIGHT + SURE * stops)


def test_beside_a_reward_sum():
    env = make(LearnedReward(action_judge()))
    env.append_transform(RewardSum(in_keys=["learned_reward"], out_keys=["learned_return"]))
    rollout = env.rollout(4, expert)
    paid = rollout["next", "learned_reward"]
    assert torch.allclose(rollout["next", "learned_return"], paid.cumsum(1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "step"}, "unknown kind 'step'"),
        ({"form": "raw"}, "unknown form 'raw'"),
        ({"kind": "both"}, "needs it as its second judge"),
        ({"goal_model": 0}, "goal_model is for kind='both'"),
        ({"kind": "goal", "form": "centred"}, "a goal pays a probability"),
        ({"weights": (1,)}, "weights are two"),
        ({"weights": (math.nan, 1)}, "weights are two"),
        ({"weights": ("a", 1)}, "weights are two"),
        ({"stop_action": -1}, "an action, from 0 on, got -1"),
        ({"stop_action": True}, "stop_action is the number of an action"),
        ({"stop_action": "last"}, "unknown stop_action 'last'"),
        ({"stop_action": 1.5}, "stop_action is the number of an action"),
        ({"arrival": 0.9}, "of the judge of goals.*kind='action'"),
        ({"kind": "goal", "arrival": 1.5}, "within 0..1, got 1.5"),
        ({"kind": "goal"}, "writes 'action_score'.* says 'goal_score'"),
    ],
)
def test_impossible_options(options, message):
    with pytest.raises(UserError, match=message):
        LearnedReward(action_judge(), **options)


def test_what_does_not_fit_the_environment_is_refused():
    with pytest.raises(UserError, match="pays 'reward' already, which stays where it is"):
        make(LearnedReward(action_judge(), reward_key="reward")).rollout(1)
    with pytest.raises(UserError, match="stop_action=99 is no action"):
        make(LearnedReward(goal_judge(), kind="goal", stop_action=99)).rollout(1)
    with pytest.raises(UserError, match="say which of them is the image after the step"):
        LearnedReward(goal_judge(), kind="goal", pixels_key="camera")


def test_who_knows_the_stop_is_asked():
    world = CounterWorld((6,), max_steps=12)
    reward = LearnedReward(goal_judge(), kind="goal")
    with pytest.raises(UserError, match="the environment does not say which action is the stop"):
        make(reward, world=world).rollout(3, expert)
    world.stop_action = STOP
    rollout = make(reward.clone(), world=world).rollout(30, expert, break_when_any_done=False)
    stops = (rollout["action"] == STOP).float()
    assert torch.allclose(rollout["next", "learned_reward"][..., 0], SURE * stops)
    with pytest.raises(UserError, match=r"a batch does not say.*stop_action="):
        LearnedReward(goal_judge(), kind="goal")(rollout)


def test_missing_entries_are_named():
    with pytest.raises(
        UserError, match=r"needs the entry 'pixels': the tensordict has \['action'\]"
    ):
        LearnedReward(action_judge())(TensorDict({"action": torch.zeros(2).long()}, [2]))
    rollout = make(LearnedReward(action_judge())).rollout(5)
    with pytest.raises(UserError, match="'initial_pixels': collect with LearnedReward"):
        goal_reward()(rollout)


def test_boolean_one_hot_actions_have_numbers():
    action = torch.tensor([[False, True, False], [True, False, False]])
    assert numbers(action).tolist() == [1, 0]


def test_images_that_a_later_transform_changes_are_refused():
    def stepped(**options):
        later = ToTensorImage(in_keys=["pixels"], shape_tolerant=True, **options)
        return make(LearnedReward(action_judge())).append_transform(later).rollout(2)

    with pytest.raises(UserError, match=r"after LearnedReward changes \['pixels'\]"):
        stepped()
    assert stepped(out_keys=["shown"])["shown"].dtype == torch.float32


def test_the_instruction_may_be_chosen_by_a_later_transform():
    def paid(*transforms):
        env = TransformedEnv(CounterWorld((6,), max_steps=12), Compose(*transforms))
        return env.rollout(9, expert, break_when_any_done=False)["next", "learned_reward"]

    sampler, reward = InstructionSampler(classifier(), POOL), LearnedReward(action_judge())
    assert torch.equal(paid(reward, sampler), paid(reward.clone(), sampler.clone()))


@pytest.mark.parametrize("inside", [True, False])
def test_what_a_composed_transform_changes_is_refused(inside):
    later = Compose(ToTensorImage(in_keys=["pixels"], shape_tolerant=True))
    reward = Compose(LearnedReward(action_judge())) if inside else LearnedReward(action_judge())
    with pytest.raises(UserError, match=r"after LearnedReward changes \['pixels'\]"):
        make(reward).append_transform(later).rollout(2)


def test_no_steps_are_paid_nothing():
    steps = make(LearnedReward(action_judge())).rollout(3)[:, :0]
    assert LearnedReward(action_judge())(steps)["next", "learned_reward"].shape == (6, 0, 1)
