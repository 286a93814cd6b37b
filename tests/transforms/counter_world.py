"""A small foreign world with pixels, and models of it that can be computed by hand.

Each row shows a number from 0 to 9 as its brightness. Actions: 0 adds one, 1 takes one away, 2
stops. The instruction [t, 0, 0, 0] asks to reach t - 1; it is suitable where the number shown is
smaller than that.
"""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv

from ifo_grounding.transforms import InstructionSampler

STOP = 2
LENGTH = 4
POOL = torch.tensor([[target, 0, 0, 0] for target in range(1, 11)])


class CounterWorld(EnvBase):
    def __init__(
        self, batch=(3,), seed=0, nested=False, max_steps=5, instructed=False, expose_state=False
    ):
        super().__init__(device="cpu", batch_size=batch)
        self.pixels_key = ("agent", "pixels") if nested else "pixels"
        self.max_steps, self.instructed, self.expose_state = max_steps, instructed, expose_state
        self._supports_set_state = expose_state
        rows = self.batch_size.numel()
        self.number, self.steps = torch.zeros(2, rows, dtype=torch.int64)
        self.scene_numbers = torch.zeros(rows, dtype=torch.int64)
        self.resets = torch.zeros(rows, dtype=torch.int64)
        self._set_seed(seed)
        shape = tuple(self.batch_size)
        self.observation_spec = Composite(shape=shape)
        if nested:
            self.observation_spec["agent"] = Composite(shape=shape)
        self.observation_spec[self.pixels_key] = Bounded(
            0, 255, shape=(*shape, 3, 8, 8), dtype=torch.uint8
        )
        if instructed:
            self.observation_spec["instruction"] = Bounded(
                0, 10, shape=(*shape, LENGTH), dtype=torch.int64
            )
        if expose_state:
            spec = Bounded(0, 9, shape=(*shape, 1), dtype=torch.int64)
            self.observation_spec["number"] = spec
            self.state_spec = Composite(number=spec.clone(), shape=shape)
        self.action_spec = Categorical(3, shape=shape)
        self.reward_spec = Unbounded(shape=(*shape, 1))
        flag = Categorical(2, shape=(*shape, 1), dtype=torch.bool)
        names = ("done", "terminated", "truncated")
        self.done_spec = Composite({name: flag.clone() for name in names}, shape=shape)

    def _set_seed(self, seed):
        self.seed, self.next_scene = seed or 0, 0

    def _reset(self, tensordict=None, **kwargs):
        given = {} if tensordict is None else tensordict
        mask = given.get("_reset", torch.ones_like(self.number, dtype=torch.bool)).reshape(-1)
        fresh = torch.arange(self.next_scene, self.next_scene + int(mask.sum()))
        if (scenes := given.get("scene", None)) is None:
            self.next_scene += len(fresh)
        else:
            fresh = scenes.reshape(-1)[mask]
        self.scene_numbers[mask] = fresh
        self.number[mask] = (fresh * 7 + self.seed) % 10
        self.steps[mask] = 0
        self.resets += mask
        return self._observe()

    def _step(self, tensordict):
        action = tensordict["action"].reshape(-1)
        self.number = (self.number + (action == 0).long() - (action == 1).long()).clamp(0, 9)
        self.steps = self.steps + 1
        result = self._observe()
        terminated = (action == STOP).view(*self.batch_size, 1)
        truncated = (self.steps >= self.max_steps).view(*self.batch_size, 1) & ~terminated
        result.update({"terminated": terminated, "truncated": truncated})
        result.update({"done": terminated | truncated})
        result["reward"] = (self.number == 7).float().view(*self.batch_size, 1)
        return result

    def _observe(self):
        shape = tuple(self.batch_size)
        result = TensorDict({}, batch_size=shape)
        shade = (self.number * 20).to(torch.uint8)
        result[self.pixels_key] = shade.view(*shape, 1, 1, 1).expand(*shape, 3, 8, 8).clone()
        if self.instructed:
            result["instruction"] = torch.ones(*shape, LENGTH, dtype=torch.int64)
        if self.expose_state:
            result["number"] = self.number.view(*shape, 1).clone()
        for name in ("done", "terminated", "truncated"):
            result[name] = torch.zeros(*shape, 1, dtype=torch.bool)
        return result


def shown(pixels):
    """Return the number that pixels [*B, 3, 8, 8] show, [*B]."""
    return pixels[..., 0, 0, 0].long() // 20


class Suitability(nn.Module):
    """Logit +3 where the target is above the number shown, else -3; noise while in train mode."""

    def __init__(self):
        super().__init__()
        self.sharpness = nn.Parameter(torch.tensor(3.0))
        self.dropout = nn.Dropout(0.9)
        self.encoded = 0

    def encode_scenes(self, pixels):
        return shown(pixels).float().unsqueeze(-1)

    def encode_instruction(self, instruction):
        self.encoded += len(instruction)
        return (instruction[..., :1] - 1).float() * self.sharpness

    def score_candidates(self, scenes, words, index):
        return self.score(scenes.expand_as(index), words[index].squeeze(-1))

    def score(self, number, target):
        above = target / self.sharpness - number > 0.5
        return self.dropout(self.sharpness * (2.0 * above - 1))

    def forward(self, pixels, instruction):
        return self.score(self.encode_scenes(pixels), self.encode_instruction(instruction))


class RewardModel(nn.Module):
    """Logit 2 for going up below the target and for stopping at it, else -1."""

    def __init__(self):
        super().__init__()
        self.right = nn.Parameter(torch.tensor(2.0))
        self.dropout = nn.Dropout(0.9)

    def forward(self, pixels, instruction, action):
        gap = instruction[..., 0] - 1 - shown(pixels)
        wanted = torch.where(gap > 0, 0, torch.where(gap < 0, 1, STOP))
        return self.dropout(torch.where(wanted == action, self.right, -1.0)).unsqueeze(-1)


class GoalClassifier(nn.Module):
    """Logit 4 where the target is shown now and was not at first, else -4."""

    def __init__(self):
        super().__init__()
        self.sure = nn.Parameter(torch.tensor(4.0))

    def forward(self, initial_pixels, pixels, instruction):
        target = instruction[..., 0] - 1
        right = (shown(pixels) == target) & (shown(initial_pixels) != target)
        return torch.where(right, self.sure, -self.sure).unsqueeze(-1)


def keys(nested, *names):
    return [("agent", name) for name in names] if nested else [*names]


def classifier(nested=False, network=None):
    read = keys(nested, "pixels", "instruction")
    return TensorDictModule(network or Suitability(), read, ["suitability"])


def constant(logit):
    """A classifier that says the same of every pair."""
    return classifier(network=lambda pixels, instruction: torch.full((len(pixels), 1), logit))


def reward_model(nested=False):
    read = [*keys(nested, "pixels", "instruction"), "action"]
    return TensorDictModule(RewardModel(), read, ["action_score"])


def goal_classifier(nested=False):
    read = keys(nested, "initial_pixels", "pixels", "instruction")
    return TensorDictModule(GoalClassifier(), read, ["goal_score"])


def make(*rewards, batch=(6,), world=None):
    """Return the world with chosen instructions and rewards."""
    sampler = InstructionSampler(classifier(), POOL)
    return TransformedEnv(world or CounterWorld(batch, max_steps=12), Compose(sampler, *rewards))


def expert(tensordict):
    gap = tensordict["instruction"][..., 0] - 1 - shown(tensordict["pixels"])
    return tensordict.set("action", torch.where(gap > 0, 0, torch.where(gap < 0, 1, STOP)))
