import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from ifo_grounding.data import Demonstrations, labelled_buffer
from ifo_grounding.errors import UserError
from ifo_grounding.training import BestCheckpoint, HeldOutAccuracy, self_examine
from training.tiny import (
    TEACH,
    config,
    likes,
    make_env,
    make_networks,
    make_policy,
    prefer,
    same,
    weights,
)

LENGTHS = (3, 5, 2) * 20


def labelled(action, lengths=LENGTHS):
    """Demonstrations of some lengths in which every label is one action."""
    draw = torch.Generator().manual_seed(0)
    frames = [
        torch.randint(256, (length, 3, 48, 48), dtype=torch.uint8, generator=draw)
        for length in lengths
    ]
    demos = Demonstrations.from_arrays(frames, ["move to the red circle"] * len(lengths))
    return labelled_buffer(demos, torch.full((demos.transitions,), action))


class Sometimes(torch.nn.Module):
    """Takes action 1, but action 0 in the first rows of a batch, as many as it is told."""

    def __init__(self):
        super().__init__()
        self.wrong = 0

    def forward(self, state):
        action = torch.ones(state.batch_size, dtype=torch.int64)
        action[: self.wrong] = 0
        return state.set("action", action)


def test_each_demonstration_counts_once():
    policy = Sometimes()
    policy.wrong = 3  # both transitions of the first, one of four of the second
    lengths = (3, 5, 2)
    assert HeldOutAccuracy(policy, labelled(1, lengths)).measure().tolist() == [0.0, 0.75, 1.0]
    assert HeldOutAccuracy(policy, labelled(0, lengths)).measure().tolist() == [1.0, 0.25, 0.0]


def test_only_what_is_clearly_below_the_first_accuracy_is_worse():
    policy = Sometimes()
    accuracy = HeldOutAccuracy(policy, labelled(1))
    policy.wrong = 20
    assert accuracy.compare() == (pytest.approx(float(accuracy.first.mean())), False)
    policy.wrong = 21
    assert not accuracy.compare()[1]
    policy.wrong = 60
    assert accuracy.compare()[1]
    policy.wrong = 0
    assert accuracy.compare() == (1.0, False)


def test_what_is_compared_with_goes_on_from_a_checkpoint():
    policy = make_policy()
    prefer(policy, 1, 9.0)
    best, again = [
        BestCheckpoint(
            make_env(),
            policy,
            seed=0,
            episodes=8,
            max_steps=2,
            held_out=HeldOutAccuracy(policy, labelled(1)),
        )
        for _ in range(2)
    ]
    assert best.consider()["held_out_accuracy"] == 1.0
    again.load_state_dict(best.state_dict())
    prefer(policy, 2, 99.0)
    assert again.consider()["selected"] == 0.0
    again.restore()
    assert again.consider()["held_out_accuracy"] == 1.0


def test_nothing_held_out_is_refused():
    with pytest.raises(UserError, match="no held-out samples"):
        HeldOutAccuracy(Sometimes(), TensorDictReplayBuffer(storage=LazyTensorStorage(4)))


@pytest.mark.parametrize("held_out", [False, True])
def test_a_policy_that_a_misleading_reward_has_changed_is_not_kept(held_out):
    """The reward model pays for an action that no demonstration shows."""
    policy, value = make_networks()
    prefer(policy, 2)
    before = weights(policy)
    accuracy = HeldOutAccuracy(policy, labelled(2)) if held_out else None
    misled = config(iterations=8, select_every=4, select_episodes=32, max_steps=5, **TEACH)
    history = self_examine(make_env(likes(1)), policy, value, misled, seed=0, held_out=accuracy)
    measured = [metrics for metrics in history if "selected" in metrics]
    assert measured[-1]["selection_return"] > 2
    assert measured[0]["selected"] == (not held_out)
    assert same(weights(policy), before) == held_out
    if held_out:
        assert measured[-1]["held_out_accuracy"] < 0.5
