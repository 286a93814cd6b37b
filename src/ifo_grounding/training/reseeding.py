"""Random numbers of an environment and its transforms as a function of a seed."""

from __future__ import annotations

import torch
from torch import nn
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.envs.transforms import Transform

from ifo_grounding.attributes import first_worker, untransformed
from ifo_grounding.seeding import derive
from ifo_grounding.training.loop import Metrics
from ifo_grounding.transforms.base import parts_of


def reseed(env: EnvBase, seed: int) -> None:
    """Seed torch, the simulator and every transform that draws; fixed starts keep their scenes."""
    torch.manual_seed(seed)
    transforms = transforms_of(env)
    for place, transform in enumerate(transforms):
        if callable(set_seed := getattr(transform, "set_seed", None)):
            set_seed(derive(seed, "transform", place) % 2**31)
    if not any(map(fixes_scenes, transforms)):
        env.set_seed(derive(seed, "simulator") % 2**31)


def fixes_scenes(transform: nn.Module) -> bool:
    """Whether a transform begins episodes in scenes that it knows by their numbers."""
    return bool(getattr(transform, "fixes_scenes", False))


def workers_fix_scenes(env: EnvBase) -> bool:
    """Whether transforms inside of workers begin episodes in scenes that they know."""
    env = untransformed(env)
    return isinstance(env, BatchedEnvBase) and any(
        map(fixes_scenes, transforms_of(first_worker(env)))
    )


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
