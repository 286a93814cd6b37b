import copy

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from ifo_grounding.training import BestCheckpoint, select_pairs, self_examine
from ifo_grounding.training.best_checkpoint import learned_returns
from ifo_grounding.transforms import LearnedReward, StartingPairs
from training.tiny import (
    POOL,
    accepts_all,
    config,
    likes,
    make_env,
    make_networks,
    prefer,
    same,
    simulator,
    weights,
)


class Always(torch.nn.Module):
    """Takes one action and stops after some steps."""

    def __init__(self, action, steps):
        super().__init__()
        self.action, self.steps, self.taken = action, steps, 0

    def forward(self, state):
        self.taken += 1
        action = self.action if self.taken <= self.steps else 5
        return state.set("action", torch.full(state.batch_size, action))


def test_each_start_counts_one_episode():
    env = make_env(likes(1), num_envs=8)
    like, dislike = 1 / (1 + torch.e**-4), 1 / (1 + torch.e**4)
    returns = learned_returns(env, Always(1, steps=3), episodes=8, max_steps=40)
    assert returns.tolist() == pytest.approx([3 * like + dislike] * 8, abs=1e-5)
    cut = learned_returns(env, Always(1, steps=100), episodes=5, max_steps=6)
    assert cut.tolist() == pytest.approx([6 * like] * 5, abs=1e-5)


@pytest.fixture(scope="module")
def env():
    return make_env(num_envs=1)


def layer_and_best(env, margin):
    layer = torch.nn.Linear(1, 1, bias=False)
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


def test_a_run_that_only_gets_worse_ends_with_the_policy_of_phase_1():
    """A huge learning rate ruins the policy; what phase 1 had learned is given back."""
    policy, value = make_networks()
    prefer(policy, 1, 6.0)
    before = weights(policy)
    ruin = config(lr=10.0, select_every=1, select_episodes=32, max_steps=5)
    history = self_examine(make_env(likes(1)), policy, value, ruin, seed=0)
    assert [metrics["selected"] for metrics in history] == [0.0, 0.0]
    assert same(weights(policy), before)


def test_stored_pairs_are_measured_from_the_same_first_starts():
    pairs = select_pairs(simulator(8), accepts_all(), POOL, 24, seed=0)
    starts = StartingPairs(pairs)
    env = TransformedEnv(simulator(8), Compose(starts, LearnedReward(likes(1))))
    policy, value = make_networks()
    first = BestCheckpoint(
        TransformedEnv(simulator(8), Compose(copy.deepcopy(starts), LearnedReward(likes(1)))),
        policy,
        seed=0,
        episodes=16,
        max_steps=4,
    ).measure()
    frozen = config(iterations=4, value_warmup=3, select_every=1, select_episodes=16, max_steps=4)
    history = self_examine(env, policy, value, frozen, seed=0)
    assert {metrics["selection_return"] for metrics in history[:3]} == {first}


def test_measuring_leaves_the_training_as_it_is():
    runs = []
    for every in (0, 1):
        chosen = config(iterations=3, select_every=every, select_episodes=16, max_steps=4)
        history = self_examine(make_env(), *make_networks(), chosen, seed=0)
        runs.append([metrics["learned_reward"] for metrics in history])
    assert runs[0] == runs[1]
