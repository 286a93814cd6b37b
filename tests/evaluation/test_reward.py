"""Audits of rewards whose quality is known."""

import json

import pytest
import torch
from tensordict.nn import TensorDictModule

from ifo_grounding.data import record_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import return_audit, reward_audit
from ifo_grounding.transforms import GoalReward, LearnedReward


@pytest.fixture(scope="module")
def recorded():
    """A few demonstrations and their truth."""
    return record_demonstrations("move", 40, keep_truth=True, stream="validation")


def scores_actions(function):
    """Wrap a function from actions [B] to logits [B]."""
    return TensorDictModule(
        lambda action: function(action).float().unsqueeze(-1), ["action"], ["action_score"]
    )


def sees_changes():
    """A goal classifier that is sure where the picture changed since the start."""
    return TensorDictModule(
        lambda first, last, words: 40.0 * (first != last).flatten(1).any(1, keepdim=True) - 20.0,
        ["initial_pixels", "pixels", "instruction"],
        ["goal_score"],
    )


def test_a_model_that_knows_only_the_stop(recorded):
    demos, truth = recorded
    audit = reward_audit(scores_actions(lambda action: 8.0 * (action == 5) - 4.0), demos, truth)
    # Of M transitions 40 are stops. S scores high: 40 of M positives, M - 40 of 5 M negatives.
    m = demos.transitions
    high, wrongly_high = 40 / m, (m - 40) / (5 * m)
    by_hand = high * (1 - wrongly_high) + 0.5 * (
        high * wrongly_high + (1 - high) * (1 - wrongly_high)
    )
    assert audit.auc.value == pytest.approx(by_hand)
    assert (audit.first.successes, audit.first.count) == (40, m)
    assert json.loads(json.dumps(audit.as_dict(), allow_nan=False))["first"]["successes"] == 40


def test_what_does_not_fit_the_demonstrations_is_refused(recorded):
    demos, truth = recorded
    model = scores_actions(lambda action: action)
    with pytest.raises(UserError, match="these very demonstrations"):
        reward_audit(model, demos[:5], truth)
    with pytest.raises(UserError, match=r"for this model, truth holds .*allowed are 0..5"):
        reward_audit(model, demos, truth.actions + 6)


def test_return_is_the_sum_of_what_is_paid(make_expert):
    expert = make_expert("move")
    options = {"episodes": 60, "expose_state": True, "batch_size": 25}
    half = LearnedReward(scores_actions(lambda action: 0.0 * action))  # every step pays 0.5
    audit = return_audit(expert.on_even_scenes, half, "move", **options)
    lengths = torch.where(torch.arange(60) % 2 == 0, expert.steps(60), 1)
    assert torch.allclose(audit.returns, 0.5 * lengths)
    assert audit.outcomes.tolist() == [True, False] * 30
    # Here longer episodes are the successful ones: a sum of probabilities cannot but agree.
    assert audit.auc.value == 1.0
    mean = return_audit(expert.on_even_scenes, half, "move", average=True, **options)
    assert torch.allclose(mean.returns, torch.full((60,), 0.5))
    assert mean.auc.value == 0.5


def test_a_goal_classifier_is_shown_the_first_and_the_last_frame(make_expert):
    # Paid where the picture changed since the start: exactly the solved scenes, which take moves.
    policy, pay = make_expert("move").on_even_scenes, GoalReward(sees_changes(), stop_action=5)
    audit = return_audit(policy, pay, "move", episodes=40, expose_state=True)
    assert torch.allclose(audit.returns, audit.outcomes.float(), atol=1e-6)
    assert audit.auc.value == 1.0


def test_arrival_is_paid_once(up):
    """Where self-examination would end the episode; here the policy wanders on."""
    pay = GoalReward(sees_changes(), stop_action=None, arrival=0.9)
    audit = return_audit(up, pay, "move", episodes=40, max_steps=5)
    assert set(audit.returns.round(decimals=5).tolist()) == {0.0, 1.0}


def test_a_network_is_no_transform(up):
    with pytest.raises(UserError, match=r"give LearnedReward\(reward_model\)"):
        return_audit(up, sees_changes(), "move", episodes=2)
