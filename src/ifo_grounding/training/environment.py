"""What self-examination asks of an environment: that it leaks nothing, and can be repeated."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase
from torchrl.envs.transforms import Transform

from ifo_grounding import keys
from ifo_grounding.attributes import first_worker
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import derive
from ifo_grounding.training.supervised import Metrics
from ifo_grounding.transforms._common import exposes_state, instructs, parts_of


def check_env(env: EnvBase) -> None:
    """Refuse an env that shows the true state or instructions, or pays no learned reward."""
    if exposes_state(env):
        raise UserError("self-examination never sees the true state: use expose_state=False")
    if instructs(env):
        raise UserError("self-examination never sees true instructions: use instructed=False")
    observed = env.observation_spec.keys(True, True)
    if keys.INSTRUCTION not in observed:
        raise UserError("the env has no instructions: add InstructionSampler or StartingPairs")
    written = [*env.full_reward_spec.keys(True, True), *observed]
    if keys.LEARNED_REWARD not in written:
        raise UserError("the env pays no learned reward: add LearnedReward or GoalReward")


def make_collector(env: EnvBase, policy: nn.Module, steps: int) -> Collector:
    """Return a collector of ``steps`` steps of each world per round, each from a reset.

    On a CPU a round is written over the one before: keep copies of what has to last.
    """
    return Collector(
        env,
        policy,
        frames_per_batch=env.batch_size.numel() * steps,
        total_frames=-1,
        reset_at_each_iter=True,
        trust_policy=True,
        auto_register_policy_transforms=False,
        return_same_td=env.device is not None and env.device.type == "cpu",
    )


def reseed(env: EnvBase, seed: int) -> None:
    """Seed torch, the simulator and every transform that draws; fixed starts keep their scenes."""
    torch.manual_seed(seed)
    transforms = transforms_of(env)
    for place, transform in enumerate(transforms):
        if callable(set_seed := getattr(transform, "set_seed", None)):
            set_seed(derive(seed, "transform", place) % 2**31)
    if not any(map(fixes_scenes, transforms)) and not workers_fix_scenes(env):
        env.set_seed(derive(seed, "simulator") % 2**31)


def fixes_scenes(transform: nn.Module) -> bool:
    """Whether a transform begins episodes in scenes that it knows by their numbers."""
    return bool(getattr(transform, "fixes_scenes", False))


def workers_fix_scenes(env: EnvBase) -> bool:
    """Whether transforms inside of workers begin episodes in scenes that they know."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    if not isinstance(env, BatchedEnvBase):
        return False
    worker = first_worker(env)
    return any(map(fixes_scenes, transforms_of(worker))) or workers_fix_scenes(worker)


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


def summary(batch: TensorDictBase) -> Metrics:
    """Describe collected steps [N, T], which begin with a reset, by what the learner can see.

    Returns and lengths are those of finished episodes: the last one of a row is mostly cut, and so
    are all that take longer than T steps.
    """
    done = batch[keys.NEXT, "done"].reshape(batch.shape)
    stopped = batch[keys.NEXT, "terminated"].reshape(batch.shape)
    reward = batch[keys.NEXT, keys.LEARNED_REWARD].reshape(batch.shape)
    finished = done.flip(-1).cumsum(-1).flip(-1) > 0
    episodes = done.sum().clamp(min=1)
    cut = (~done[..., -1]).sum()
    return {
        "frames": float(batch.numel()),
        "learned_reward": float(reward.mean()),
        "learned_return": float((reward * finished).sum() / episodes),
        "episode_length": float(finished.sum() / episodes),
        "stopped": float(stopped.sum() / episodes),
        "unfinished": float(cut / (done.sum() + cut)),
    }
