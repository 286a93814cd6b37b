import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from ifo_grounding.data import Demonstrations, labelled_buffer
from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_reward_model
from ifo_grounding.objectives import RewardLoss
from ifo_grounding.training import Adversary, Guard, Selection, SelectionSchedule, self_examine
from training.test_self_examination import (
    SMALL,
    config,
    likes,
    make_env,
    make_networks,
    simulator,
)

LENGTHS = (3, 5, 2) * 20


def held_out(action, lengths=LENGTHS):
    """Demonstrations of some lengths in which every label is one action."""
    draw = torch.Generator().manual_seed(0)
    frames = [
        torch.randint(256, (length, 3, 48, 48), dtype=torch.uint8, generator=draw)
        for length in lengths
    ]
    demos = Demonstrations.from_arrays(frames, ["move to the red circle"] * len(lengths))
    actions = torch.full((demos.transitions,), action)
    return labelled_buffer(demos, actions)


class Sometimes(torch.nn.Module):
    """Takes action 1 in bright images and, at other times, action 0 as often as it is told to."""

    def __init__(self):
        super().__init__()
        self.wrong = 0

    def forward(self, state):
        action = torch.ones(state.batch_size, dtype=torch.int64)
        action[: self.wrong] = 0
        return state.set("action", action)


def test_each_demonstration_counts_once():
    policy = Sometimes()
    guard = Guard(policy, held_out(1, (3, 5, 2)))
    policy.wrong = 3  # both transitions of the first, one of four of the second
    assert guard.agreement().tolist() == [0.0, 0.75, 1.0]
    assert Guard(policy, held_out(0, (3, 5, 2)), batch_size=100).agreement().tolist() == [
        1,
        0.25,
        0,
    ]


def test_only_who_clearly_falls_behind_the_first_look_is_astray():
    policy = Sometimes()
    guard = Guard(policy, held_out(1))
    policy.wrong = 20
    assert guard.look() == (pytest.approx(float(guard.first.mean())), False)
    policy.wrong = 21
    assert not guard.look()[1]
    policy.wrong = 60
    assert guard.look()[1]
    policy.wrong = 0
    assert guard.look() == (1.0, False)
    again = Guard(policy, held_out(1))
    again.load_state_dict(guard.state_dict())
    policy.wrong = 60
    assert again.look()[1]


def test_beside_an_adversary_the_policy_that_agrees_most_is_kept():
    """The judge's own returns would keep the last policy, which the judge has led astray."""
    policy, value = make_networks()
    torch.nn.init.constant_(policy[0].module.head[-1].bias[2], 1.0)
    before = {name: weight.clone() for name, weight in policy.state_dict().items()}
    misled = config(iterations=2, gamma=0.0, lr=3e-3, entropy=0.0, epochs=3, select_every=1)
    guard = Guard(policy, held_out(2))
    still = Adversary(RewardLoss(make_reward_model(simulator(1), **SMALL)), held_out(2), 1, 0.0)
    history = self_examine(
        make_env(likes(1)), policy, value, misled, seed=0, guard=guard, adversary=still
    )
    assert [metrics["selected"] for metrics in history] == [0, 0]
    assert history[-1]["agreement"] < 0.5
    assert "selection_return" not in history[-1]
    assert all(torch.equal(weight, before[name]) for name, weight in policy.state_dict().items())
    with pytest.raises(UserError, match="give a guard"):
        self_examine(make_env(likes(1)), policy, value, misled, seed=0, adversary=still)


def test_a_choice_by_agreement_needs_demonstrations():
    policy, _ = make_networks()
    schedule = SelectionSchedule(every=1, iterations=1, episodes=1, max_steps=1, margin=0.0)
    with pytest.raises(UserError, match="needs a guard"):
        Selection(make_env(), policy, schedule, seed=0, by_agreement=True)


def test_nothing_held_out_is_refused():
    with pytest.raises(UserError, match="no held-out samples"):
        Guard(Sometimes(), TensorDictReplayBuffer(storage=LazyTensorStorage(4)))


@pytest.mark.parametrize("guarded", [False, True])
def test_practice_for_a_judge_that_leads_astray_is_given_up(guarded, tmp_path):
    """The judge pays for an action that no demonstration shows."""
    policy, value = make_networks()
    torch.nn.init.constant_(policy[0].module.head[-1].bias[2], 1.0)
    before = {name: weight.clone() for name, weight in policy.state_dict().items()}
    guard = Guard(policy, held_out(2)) if guarded else None
    misled = config(
        iterations=4, gamma=0.0, lr=3e-3, entropy=0.0, epochs=3, select_every=2, max_steps=5
    )
    file = tmp_path / "checkpoint.pt"
    history = self_examine(
        make_env(likes(1)), policy, value, misled, seed=0, guard=guard, checkpoint=file
    )
    looks = [metrics for metrics in history if "selected" in metrics]
    same = all(torch.equal(weight, before[name]) for name, weight in policy.state_dict().items())
    assert looks[-1]["selection_return"] > 2
    assert same == guarded
    assert looks[0]["selected"] == (not guarded)
    if guarded:
        assert looks[-1]["agreement"] < 0.5
