"""Random numbers of an environment and its transforms as a function of a seed."""

from __future__ import annotations

import torch
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform

from ifo_grounding.seeding import derive
from ifo_grounding.training.loop import Metrics
from ifo_grounding.transforms.base import parts_of


def reseed(env: EnvBase, seed: int) -> None:
    """Seed torch, the simulator and every transform that draws; stored starts keep their scenes."""
    torch.manual_seed(seed)
    for place, transform in enumerate(transforms_of(env)):
        if callable(set_seed := getattr(transform, "set_seed", None)):
            set_seed(derive(seed, "transform", place) % 2**31)
    if not stored_starts(env):
        env.set_seed(derive(seed, "simulator") % 2**31)


def stored_starts(env: EnvBase) -> list[Transform]:
    """Return the transforms that begin episodes in scenes that they know by their numbers."""
    return [each for each in transforms_of(env) if getattr(each, "fixes_scenes", False)]


def sampler_stats(env: EnvBase) -> Metrics:
    """Return what the transforms counted since the last call."""
    found: Metrics = {}
    for transform in transforms_of(env):
        if callable(stats := getattr(transform, "stats", None)):
            found |= {key: float(value) for key, value in stats().items()}
    return found


def transforms_of(env: EnvBase) -> list[Transform]:
    """Return the transforms around an env, the innermost first; not those inside of workers."""
    if not isinstance(env, TransformedEnv):
        return []
    return [*transforms_of(env.base_env), *parts_of(env.transform)]
