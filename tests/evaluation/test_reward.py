"""Audits of rewards whose quality is known."""

from __future__ import annotations

import json
import math

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import SerialEnv

from ifo_grounding.data import record_demonstrations
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import return_correlation, reward_audit
from ifo_grounding.networks import make_goal_classifier, make_policy, make_reward_model
from ifo_grounding.transforms import LearnedReward


@pytest.fixture(scope="module")
def recorded():
    """A few demonstrations and their truth."""
    return record_demonstrations("move", 40, keep_truth=True, stream="validation")


def judge_of_actions(function):
    """Wrap a function from actions [B] to logits [B]."""
    return TensorDictModule(
        lambda action: function(action).float().unsqueeze(-1), ["action"], ["action_score"]
    )


def test_a_judge_that_knows_only_the_stop(recorded):
    demos, truth = recorded
    audit = reward_audit(judge_of_actions(lambda action: 8.0 * (action == 5) - 4.0), demos, truth)
    # Of M transitions 40 are stops. S scores high: 40 of M positives, M - 40 of 5 M negatives.
    m = demos.transitions
    high, wrongly_high = 40 / m, (m - 40) / (5 * m)
    by_hand = high * (1 - wrongly_high) + 0.5 * (
        high * wrongly_high + (1 - high) * (1 - wrongly_high)
    )
    assert audit.auc.value == pytest.approx(by_hand)
    assert (audit.first.successes, audit.first.count) == (40, m)
    assert audit.per_action["S"].value == 0.5  # blind to where the stop is right
    assert math.isnan(audit.per_action["P"].value)  # move never places
    assert json.loads(json.dumps(audit.as_dict(), allow_nan=False))["first"]["successes"] == 40


def test_a_judge_that_knows_the_expert(recorded):
    demos, truth = recorded
    taken = dict(
        zip(
            [picture.numpy().tobytes() for picture in demos.frames(demos.locate()[1])],
            truth.actions.tolist(),
            strict=True,
        )
    )

    def right(pixels, action):
        known = torch.tensor([taken[picture.numpy().tobytes()] for picture in pixels])
        return (known == action).float().unsqueeze(-1)

    judge = TensorDictModule(right, ["pixels", "action"], ["action_score"])
    # A frame before the stop equals no other frame here, so that pictures tell the action.
    audit = reward_audit(judge, demos, truth)
    assert audit.auc.value == 1.0 and audit.first.rate == 1.0
    assert all(math.isnan(a.value) or a.value == 1.0 for a in audit.per_action.values())


def test_an_untrained_model_is_no_better_than_chance_and_keeps_its_mode(recorded):
    demos, truth = recorded
    model = make_reward_model(demos, "paper", seed=0).train()
    audit = reward_audit(model, demos, truth, transitions=100)
    assert model.training
    assert audit.first.count == 100
    assert 0.2 < audit.auc.value < 0.8
    again = reward_audit(model, demos, truth, transitions=100)
    assert again == audit


def test_truth_of_other_demonstrations_is_refused(recorded):
    demos, truth = recorded
    with pytest.raises(UserError, match="these very demonstrations"):
        reward_audit(judge_of_actions(lambda action: action), demos[:5], truth)


def test_actions_without_a_name_are_refused(recorded):
    demos, truth = recorded
    judge = judge_of_actions(lambda action: action)
    with pytest.raises(UserError, match="of 3 with a name"):
        reward_audit(judge, demos, truth, names="LRS")
    with pytest.raises(UserError, match="judges 6 actions, not 7"):
        reward_audit(make_reward_model(demos, "paper", seed=0), demos, truth, names="URDLPSX")
    with pytest.raises(UserError, match="at least 1"):
        reward_audit(judge, demos, truth, transitions=0)


def half_expert(make_expert):
    """Solve even scenes; stop at once in odd ones."""
    expert = make_expert("move")

    def act(td):
        action = expert(td)["action"]
        return td.set("action", torch.where(td["scene"].squeeze(-1) % 2 == 0, action, 5))

    return act, expert


def test_return_is_the_sum_of_what_is_paid(make_expert):
    policy, expert = half_expert(make_expert)
    options = {"episodes": 60, "expose_state": True, "batch_size": 25}
    half = judge_of_actions(lambda action: 0.0 * action)  # every step pays 0.5
    audit = return_correlation(policy, half, "move", **options)
    lengths = torch.where(torch.arange(60) % 2 == 0, expert.steps(60), 1)
    assert torch.allclose(audit.returns, 0.5 * lengths)
    assert audit.outcomes.tolist() == [True, False] * 30
    # Here longer episodes are the successful ones: a sum of probabilities cannot but agree.
    assert audit.auc.value == 1.0 and audit.correlation.value > 0.7
    mean = return_correlation(policy, half, "move", average=True, **options)
    assert torch.allclose(mean.returns, torch.full((60,), 0.5))
    assert math.isnan(mean.correlation.value) and mean.auc.value == 0.5
    discounted = return_correlation(policy, half, "move", discount=0.5, **options)
    assert torch.allclose(discounted.returns, 1 - 0.5**lengths)
    centred = return_correlation(policy, LearnedReward(half, form="centred"), "move", **options)
    assert torch.equal(centred.returns, torch.zeros(60))


def test_a_reward_that_pays_for_failure(make_expert):
    policy, _ = half_expert(make_expert)
    moves_cost = judge_of_actions(lambda action: torch.where(action == 5, 0.0, -50.0))
    audit = return_correlation(
        policy, LearnedReward(moves_cost, form="log-odds"), "move", episodes=40, expose_state=True
    )
    assert audit.correlation.value < -0.7 and audit.auc.value == 0.0
    assert audit.success.rate == 0.5
    assert json.loads(json.dumps(audit.as_dict(), allow_nan=False))["auc"]["value"] == 0.0


def test_real_models_of_both_kinds(recorded):
    demos, _ = recorded
    policy = make_policy(demos, "paper", seed=0)
    for pay in (
        make_reward_model(demos, "paper", seed=0),
        LearnedReward(make_goal_classifier(demos, "paper", seed=0), kind="goal"),
    ):
        audit = return_correlation(policy, pay, "move", episodes=100)
        assert torch.isfinite(audit.returns).all() and (audit.returns >= 0).all()
        assert audit.success.count == 100


def test_worlds_in_workers_are_judged(recorded):
    demos, _ = recorded
    policy = make_policy(demos, "paper", seed=0)
    judge = make_goal_classifier(demos, "paper", seed=0)
    worlds = SerialEnv(3, lambda: PickAndPlaceEnv("move", num_envs=2, seed=0))
    audit = return_correlation(
        policy, LearnedReward(judge, kind="goal", stop_action=5), worlds, episodes=8, max_steps=10
    )
    assert audit.success.count == 8 and torch.isfinite(audit.returns).all()


def test_a_goal_judge_is_shown_the_first_and_the_last_frame(make_expert):
    policy, _ = half_expert(make_expert)
    # Paid where the picture changed since the start: exactly the solved scenes, which take moves.
    judge = TensorDictModule(
        lambda first, last, words: 40.0 * (first != last).flatten(1).any(1, keepdim=True) - 20.0,
        ["initial_pixels", "pixels", "instruction"],
        ["goal_score"],
    )
    audit = return_correlation(
        policy, LearnedReward(judge, kind="goal"), "move", episodes=40, expose_state=True
    )
    assert torch.allclose(audit.returns, audit.outcomes.float(), atol=1e-6)
    assert audit.correlation.value == pytest.approx(1.0)


def test_arrival_is_paid_once():
    """Where practice would end the episode; here the policy wanders on."""
    judge = TensorDictModule(
        lambda first, last, words: 40.0 * (first != last).flatten(1).any(1, keepdim=True) - 20.0,
        ["initial_pixels", "pixels", "instruction"],
        ["goal_score"],
    )

    def up(td):
        return td.set("action", torch.zeros(td.shape, dtype=torch.int64))

    pay = LearnedReward(judge, kind="goal", arrival=0.9)
    audit = return_correlation(up, pay, "move", episodes=40, max_steps=5)
    assert set(audit.returns.round(decimals=5).tolist()) == {0.0, 1.0}
