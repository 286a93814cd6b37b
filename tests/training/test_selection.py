import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv

from ifo_grounding.errors import UserError
from ifo_grounding.training import (
    BestCheckpoint,
    EarlyStopping,
    FitConfig,
    HeldOutAccuracy,
    fit,
    self_examine,
)
from ifo_grounding.training.selection import learned_returns
from ifo_grounding.transforms import LearnedReward, StartingPairs
from training import tiny

SHORT = {"select_episodes": 16, "max_steps": 3}


class Square(nn.Module):
    """(weight - target)^2, the mean over a batch, with a little noise in train mode."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, batch):
        loss = ((self.weight - batch["target"]) ** 2).mean()
        return TensorDict({"loss_square": loss + 1e-3 * torch.rand(()) * self.training})


def buffer(values):
    found = TensorDictReplayBuffer(storage=LazyTensorStorage(len(values)), batch_size=4)
    found.extend(TensorDict({"target": torch.tensor(values)}, [len(values)]))
    return found


def test_the_loss_is_the_mean_over_all_samples_and_the_best_weights_come_back(monkeypatch):
    monkeypatch.setattr("ifo_grounding.training.selection.AT_ONCE", 2)
    loss, state = Square(), torch.random.get_rng_state()
    early_stopping = EarlyStopping(loss, buffer([1.0, 2.0, 3.0]))
    measured = []
    for weight in (0.0, 2.0, 5.0):
        loss.weight.data.fill_(weight)
        measured.append(early_stopping.measure()["held_out_loss"])
    assert measured == pytest.approx([(1 + 4 + 9) / 3, 2 / 3, (16 + 9 + 4) / 3])
    assert loss.training
    assert torch.equal(state, torch.random.get_rng_state())
    early_stopping.restore()
    assert loss.weight.item() == 2.0


def test_fit_ends_with_the_weights_that_did_best_also_after_a_pause(tmp_path):
    config = FitConfig(steps=100, batch_size=8, lr=0.1, schedule="constant", iteration=5)

    def run(**options):
        loss = Square()
        stop = EarlyStopping(loss, buffer([2.0]))
        history = fit(loss, buffer([10.0] * 8), config, seed=0, held_out=stop, **options)
        return loss.weight.item(), history

    weight, history = run()
    seen = [row["held_out_loss"] for row in history if "held_out_loss" in row]
    assert len(seen) == 5
    assert (weight - 2) ** 2 == pytest.approx(min(seen), rel=1e-4)
    assert min(seen) < seen[-1]
    run(checkpoint=tmp_path / "a.pt", until=60)
    assert run(checkpoint=tmp_path / "a.pt")[0] == weight


class Sometimes(nn.Module):
    """Takes action 1, but action 0 in the first rows of a batch, as many as it is told."""

    wrong = 0

    def forward(self, state):
        action = torch.ones(state.batch_size, dtype=torch.int64)
        action[: self.wrong] = 0
        return state.set("action", action)


def test_each_demonstration_counts_once():
    policy = Sometimes()
    policy.wrong = 3  # both transitions of the first, one of four of the second
    lengths = (3, 5, 2)
    assert HeldOutAccuracy(policy, tiny.labelled(1, lengths)).measure().tolist() == [0.0, 0.75, 1.0]
    assert HeldOutAccuracy(policy, tiny.labelled(0, lengths)).measure().tolist() == [1.0, 0.25, 0.0]
    for make in (EarlyStopping, HeldOutAccuracy):
        with pytest.raises(UserError, match="no held-out samples"):
            make(policy, TensorDictReplayBuffer(storage=LazyTensorStorage(4)))


def test_only_what_is_clearly_below_the_first_accuracy_is_worse():
    policy = Sometimes()
    accuracy, worse = HeldOutAccuracy(policy, tiny.labelled(1)), []
    for policy.wrong in (20, 21, 60, 0):
        worse.append(accuracy.compare()[1])
    assert worse == [False, False, True, False]
    assert accuracy.compare()[0] == 1.0


def test_what_is_compared_with_goes_on_from_a_checkpoint():
    policy = tiny.make_policy()
    tiny.prefer(policy, 1, 9.0)
    options = {"seed": 0, "episodes": 8, "max_steps": 2}
    best, again = (
        BestCheckpoint(tiny.make_env(), policy, held_out=accuracy, **options)
        for accuracy in [HeldOutAccuracy(policy, tiny.labelled(1)) for _ in range(2)]
    )
    assert best.measure()["held_out_accuracy"] == 1.0
    again.load_state_dict(best.state_dict())
    tiny.prefer(policy, 2, 99.0)
    assert again.measure()["selected"] == 0.0
    again.restore()
    assert again.measure()["held_out_accuracy"] == 1.0


@pytest.mark.parametrize("held_out", [False, True])
def test_a_policy_that_a_misleading_reward_has_changed_is_not_kept(held_out):
    policy, value = tiny.make_networks()
    tiny.prefer(policy, 2)
    before = tiny.weights(policy)
    accuracy = HeldOutAccuracy(policy, tiny.labelled(2)) if held_out else None
    misled = tiny.config(iterations=4, select_every=2, **SHORT, **tiny.TEACH)
    history = self_examine(tiny.make_env(), policy, value, misled, seed=0, held_out=accuracy)
    measured = [metrics for metrics in history if "selected" in metrics]
    assert measured[-1]["selection_return"] > 2
    assert measured[0]["selected"] == (not held_out)
    assert tiny.same(tiny.weights(policy), before) == held_out
    if held_out:
        assert measured[-1]["held_out_accuracy"] < 0.5


class Always(nn.Module):
    """Takes one action and stops after some steps."""

    def __init__(self, action, steps):
        super().__init__()
        self.action, self.steps, self.taken = action, steps, 0

    def forward(self, state):
        self.taken += 1
        action = self.action if self.taken <= self.steps else 5
        return state.set("action", torch.full(state.batch_size, action))


def test_each_start_counts_one_episode():
    env = tiny.make_env(tiny.likes(1), num_envs=8)
    like, dislike = 1 / (1 + torch.e**-4), 1 / (1 + torch.e**4)
    returns = learned_returns(env, Always(1, steps=3), episodes=8, max_steps=40)
    assert returns.tolist() == pytest.approx([3 * like + dislike] * 8, abs=1e-5)
    cut = learned_returns(env, Always(1, steps=100), episodes=5, max_steps=6)
    assert cut.tolist() == pytest.approx([6 * like] * 5, abs=1e-5)


@pytest.fixture(scope="module")
def env():
    return tiny.make_env(num_envs=1)


def layer_and_best(env, margin):
    layer = nn.Linear(1, 1, bias=False)
    return layer, BestCheckpoint(env, layer, seed=0, margin=margin)


def change(layer):
    with torch.no_grad():
        layer.weight.add_(1)


def test_only_a_clear_gain_replaces_the_best_policy(env):
    layer, best = layer_and_best(env, margin=2.0)
    assert best.keep(torch.zeros(100))
    first = layer.weight.clone()
    change(layer)
    noise = torch.randn(100, generator=torch.Generator().manual_seed(0))
    assert not best.keep(noise - noise.mean())
    best.restore()
    assert torch.equal(layer.weight, first)
    change(layer)
    assert best.keep(torch.full((100,), 0.5))
    other, again = layer_and_best(env, margin=2.0)
    again.load_state_dict(best.state_dict())
    again.restore()
    assert torch.equal(other.weight, layer.weight)


def test_under_the_one_standard_error_rule_what_is_not_clearly_worse_is_kept(env):
    layer, best = layer_and_best(env, margin=-1.0)
    returns = (torch.arange(100) < 90).float()
    assert best.keep(returns)
    change(layer)
    slightly_worse = returns.clone()
    slightly_worse[:2], slightly_worse[90] = 0.0, 1.0
    assert best.keep(slightly_worse)
    assert torch.equal(best.weights["weight"], layer.weight)
    # What comes next is compared with the highest returns, so that small losses do not add up.
    assert torch.equal(best.best, returns)
    assert not best.keep((torch.arange(100) < 80).float())


def test_stored_pairs_are_measured_from_the_same_first_starts():
    starts, paid = StartingPairs(tiny.pairs()), LearnedReward(tiny.likes(1))
    env = TransformedEnv(tiny.simulator(8), Compose(starts, paid))
    policy, value = tiny.make_networks()
    other = TransformedEnv(tiny.simulator(8), Compose(copy.deepcopy(starts), copy.deepcopy(paid)))
    first = BestCheckpoint(other, policy, seed=0, episodes=16, max_steps=3).measure()
    frozen = tiny.config(iterations=3, value_warmup=2, select_every=1, **SHORT)
    history = self_examine(env, policy, value, frozen, seed=0)
    returns = {metrics["selection_return"] for metrics in history[:2]}
    assert returns == {first["selection_return"]}


def test_measuring_leaves_the_training_as_it_is():
    runs = []
    for every in (0, 1):
        chosen = tiny.config(select_every=every, select_episodes=16, max_steps=2)
        history = self_examine(tiny.make_env(), *tiny.make_networks(), chosen, seed=0)
        runs.append([metrics["learned_reward"] for metrics in history])
    assert runs[0] == runs[1]
