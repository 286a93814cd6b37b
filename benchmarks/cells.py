"""`move` of two numbers, a world for small networks that libraries learn in side by side."""

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Bounded

from ifo_grounding import keys
from ifo_grounding.data import record_demonstrations
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.seeding import derive

WORLDS, STEPS, ROUNDS = 128, 32, 30
EVERY = 10
"""Rounds between two measures."""
DEMONSTRATIONS, EPISODES = 200, 1000
PPO = {"lr": 1e-3, "gamma": 0.95, "lmbda": 0.95, "epochs": 4, "minibatch": 512}
PPO |= {"clip": 0.2, "entropy": 0.01, "grad_clip": 1.0}
DISCRIMINATOR = {"steps": 10, "lr": 1e-3, "batch_size": 256}
POLICY_SIZES, DISCRIMINATOR_SIZES = (64, 64), (32, 32)


class Cells(PickAndPlaceEnv):
    """Its image says how many rows and columns the arm has to go, and 5: uint8 [N, 2, 1, 1]."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__("move", *args, **options)
        shape = (self.num_envs, 2, 1, 1)
        self.observation_spec[keys.PIXELS] = Bounded(0, 255, shape, dtype=torch.uint8)

    def _observe(self):
        shown, size = super()._observe(), self.options.layout.size
        arm, there = self.truth.state.arm, self.truth.wanted.destination
        ways = torch.stack([there // size - arm // size, there % size - arm % size], 1)
        return shown.set(keys.PIXELS, (ways + 5).to(torch.uint8)[..., None, None])


def numbers(image: Tensor) -> Tensor:
    """Map images, uint8 [*B, 2, 1, 1], to what networks read, float32 [*B, 2] in -1..1."""
    return image.flatten(-3).float() / 5 - 1


def demonstrated(seed: int) -> tuple[list[Tensor], list[Tensor]]:
    """Return the images, uint8 [T + 1, 2, 1, 1], and the actions, int64 [T], of each episode."""
    demos, truth = record_demonstrations("move", DEMONSTRATIONS, seed=seed, keep_truth=True)
    env = Cells(DEMONSTRATIONS, seed=derive(seed, "demonstrations"))
    actions = truth.actions.long().split((demos.lengths - 1).tolist())
    state = env.reset()
    images = [state[keys.PIXELS]]
    for step in range(max(map(len, actions))):
        # A demonstration that is over stops again and again.
        taken = [a[step] if step < len(a) else torch.tensor(keys.STOP) for a in actions]
        state = env.step(state.set(keys.ACTION, torch.stack(taken)))[keys.NEXT]
        images.append(state[keys.PIXELS])
    shown = torch.stack(images, 1)
    return [shown[row, : len(a) + 1] for row, a in enumerate(actions)], list(actions)


def solved_by(act: Any) -> Tensor:
    """Return which evaluation scenes a policy solves, bool [EPISODES]: images to actions [N]."""
    env = Cells(EPISODES, seed=0, stream="evaluation")
    state, solved = env.reset(), torch.zeros(EPISODES, dtype=torch.bool)
    running = ~solved
    for _ in range(40):
        state = env.step(state.set(keys.ACTION, act(state[keys.PIXELS])))[keys.NEXT]
        solved |= running & (state[keys.REWARD] > 0).flatten()
        running &= ~state["done"].flatten()
    return solved
