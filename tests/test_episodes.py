"""The player: each row plays one episode, for any policy and any world."""

from functools import partial

import gymnasium
import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torchrl.data import Unbounded
from torchrl.envs import GymWrapper, SerialEnv, TensorDictPrimer, TransformedEnv

from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.episodes import play

STOP = 5


def test_a_policy_hands_its_memory_to_itself():
    """It walks up until its count, which differs by row, is used up; then it stops."""

    def count(memory):
        return torch.where(memory > 0, 0, STOP).squeeze(-1), memory - 1

    policy = TensorDictModule(count, ["memory"], ["action", ("next", "memory")])
    primer = TensorDictPrimer(memory=Unbounded((1,), dtype=torch.int64), expand_specs=True)
    env = TransformedEnv(PickAndPlaceEnv("move", num_envs=4, seed=0), primer)
    start = env.reset()
    start["memory"] = torch.tensor([[2], [0], [3], [8]])
    outcomes = play(policy, env, start, max_steps=5)
    assert outcomes.lengths.tolist() == [3, 1, 4, 5]
    assert outcomes.stopped.tolist() == [True, True, True, False]


class Refusing(gymnasium.Env):
    """Ends after its own number of steps, and refuses steps past its end."""

    observation_space = gymnasium.spaces.Box(0, 255, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(6)

    def __init__(self, lasts):
        self.lasts = lasts

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = self.lasts
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.left > 0, "stepped past the end"
        self.left -= 1
        return np.zeros(1, np.float32), float(self.left == 0), self.left == 0, False, {}


def world(lasts):
    return GymWrapper(Refusing(lasts), categorical_action_encoding=True)


def test_worlds_are_not_stepped_past_their_end():
    env = SerialEnv(2, [partial(world, 1), partial(world, 3)])
    asked = []

    def policy(td):
        asked.append(len(td))
        return td.set("action", torch.zeros(len(td), dtype=torch.int64))

    outcomes = play(policy, env, env.reset(), max_steps=9)
    assert outcomes.lengths.tolist() == [1, 3]
    assert outcomes.success.all() and asked == [2, 1, 1]
