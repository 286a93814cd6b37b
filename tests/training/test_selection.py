import copy

import gymnasium
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Unbounded
from torchrl.envs import Compose, GymWrapper, SerialEnv, TensorDictPrimer, TransformedEnv

from ifo_grounding.networks import Shapes, make_instruction_classifier
from ifo_grounding.training import select_pairs, self_examine
from ifo_grounding.training.selection import BestPolicy, Selection, learned_returns
from ifo_grounding.transforms import InstructionSampler, LearnedReward, StartingPairs
from training.test_self_examination import (
    POOL,
    accepts_all,
    config,
    likes,
    make_env,
    make_networks,
    simulator,
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


def test_a_policy_remembers_while_it_is_looked_at():
    """It stops at its third step by an entry that it hands on to itself; each step pays a half."""

    def count(memory):
        return torch.where(memory < 2, 0, 5).squeeze(-1), memory + 1

    judge = TensorDictModule(lambda action: 0.0 * action[..., None], ["action"], ["action_score"])
    policy = TensorDictModule(count, ["memory"], ["action", ("next", "memory")])
    primer = TensorDictPrimer(memory=Unbounded((1,), dtype=torch.int64), expand_specs=True)
    sampler = InstructionSampler(accepts_all(), POOL)
    env = TransformedEnv(simulator(4), Compose(sampler, LearnedReward(judge), primer))
    assert learned_returns(env, policy, episodes=4, max_steps=40).tolist() == [1.5] * 4


class Strict(gymnasium.Env):
    """Ends after two to five steps, and refuses one more."""

    observation_space = gymnasium.spaces.Dict(
        {"pixels": gymnasium.spaces.Box(0, 255, (3, 16, 16), np.uint8)}
    )
    action_space = gymnasium.spaces.Discrete(6)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(2, 6))
        return {"pixels": np.zeros((3, 16, 16), np.uint8)}, {}

    def step(self, action):
        assert self.left, "a step after the end"
        self.left -= 1
        return {"pixels": np.zeros((3, 16, 16), np.uint8)}, 0.0, not self.left, False, {}


def test_worlds_that_refuse_to_be_stepped_past_their_end_are_not():
    shapes = Shapes((3, 16, 16), 9, instruction_length=4, n_actions=6)
    pool = torch.arange(1, 9).view(2, 4)
    sampler = InstructionSampler(make_instruction_classifier(shapes, seed=0), pool, threshold=0.0)
    judge = TensorDictModule(lambda action: 0.0 * action[..., None], ["action"], ["action_score"])
    worlds = SerialEnv(3, lambda: GymWrapper(Strict(), categorical_action_encoding=True))
    env = TransformedEnv(worlds, Compose(sampler, LearnedReward(judge)))
    env.set_seed(0)
    returns = learned_returns(env, Always(1, steps=100), episodes=9, max_steps=40)
    assert len(returns.unique()) > 1
    assert {*returns.tolist()} <= {1.0, 1.5, 2.0, 2.5}


def test_only_a_clear_gain_replaces_the_best_policy():
    layer = torch.nn.Linear(1, 1, bias=False)
    best = BestPolicy(layer, margin=2.0)
    assert best.consider(torch.zeros(100))
    first = layer.weight.clone()
    with torch.no_grad():
        layer.weight.add_(1)
    noise = torch.randn(100, generator=torch.Generator().manual_seed(0))
    assert not best.consider(noise - noise.mean())
    best.restore()
    assert torch.equal(layer.weight, first)
    with torch.no_grad():
        layer.weight.add_(2)
    assert best.consider(torch.full((100,), 0.5))
    other = BestPolicy(torch.nn.Linear(1, 1, bias=False), margin=2.0)
    other.load_state_dict(best.state_dict())
    other.restore()
    assert torch.equal(other.policy.weight, layer.weight)


def test_practice_that_does_no_clear_harm_is_kept_under_the_one_standard_error_rule():
    layer = torch.nn.Linear(1, 1, bias=False)
    best = BestPolicy(layer, margin=-1.0)
    returns = (torch.arange(100) < 90).float()
    assert best.consider(returns)
    with torch.no_grad():
        layer.weight.add_(1)
    slightly_worse = returns.clone()
    slightly_worse[:2], slightly_worse[90:] = 0.0, torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    assert best.consider(slightly_worse)
    assert torch.equal(best.weights["weight"], layer.weight)
    # What comes next is compared with the highest returns, so that small losses do not add up.
    assert torch.equal(best.returns, returns)
    assert not best.consider((torch.arange(100) < 80).float())


def test_a_run_that_only_gets_worse_ends_with_the_policy_of_phase_1():
    """A huge learning rate ruins the policy; what phase 1 had learned is given back."""
    policy, value = make_networks()
    torch.nn.init.constant_(policy[0].module.head[-1].bias[1], 6.0)  # it does what the judge likes
    before = {name: weight.clone() for name, weight in policy.state_dict().items()}
    env = make_env(likes(1))
    ruin = config(iterations=2, lr=1.0, select_every=1, select_episodes=32, max_steps=5)
    history = self_examine(env, policy, value, ruin, seed=0)
    assert [metrics["selected"] for metrics in history] == [0.0, 0.0]
    assert all(torch.equal(w, before[n]) for n, w in policy.state_dict().items())


def test_stored_pairs_are_looked_at_from_the_same_starts():
    pairs = select_pairs(simulator(8), accepts_all(), POOL, 24, seed=0)
    env = TransformedEnv(simulator(8), Compose(StartingPairs(pairs), LearnedReward(likes(1))))
    policy, value = make_networks()
    frozen = config(iterations=4, value_warmup=3, select_every=1, select_episodes=16, max_steps=4)
    history = self_examine(env, policy, value, frozen, seed=0)
    assert len({metrics["selection_return"] for metrics in history[:3]}) == 1


def test_the_first_look_is_at_the_first_stored_pairs(monkeypatch):
    """As that of a control, which makes its selection before anything is played."""
    remembered = []

    class Seen(Selection):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            remembered.extend(self.first_starts)

    monkeypatch.setattr("ifo_grounding.training.self_examination.Selection", Seen)
    pairs = select_pairs(simulator(8), accepts_all(), POOL, 24, seed=0)
    starts = StartingPairs(pairs)
    env = TransformedEnv(simulator(8), Compose(starts, LearnedReward(likes(1))))
    first = copy.deepcopy(starts.state_dict())
    self_examine(env, *make_networks(), config(iterations=1, select_every=1), seed=0)
    assert all(torch.equal(value, first[name]) for name, value in remembered[0].items())


def test_looking_leaves_the_training_as_it_is():
    runs = []
    for select_every in (0, 1):
        sampler = InstructionSampler(accepts_all(), POOL)
        env = TransformedEnv(simulator(), Compose(sampler, LearnedReward(likes(1))))
        networks = make_networks()
        looked = config(iterations=3, select_every=select_every, select_episodes=16, max_steps=4)
        history = self_examine(env, *networks, looked, seed=0)
        runs.append([metrics["learned_reward"] for metrics in history])
    assert runs[0] == runs[1]
