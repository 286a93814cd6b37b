"""Scenes by number, their hash, and one episode of each."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding import keys, modules
from ifo_grounding.attributes import attribute
from ifo_grounding.envs import GymnasiumEnv, PickAndPlaceEnv
from ifo_grounding.envs.base import begin
from ifo_grounding.episodes import Outcomes, Policy, play
from ifo_grounding.errors import UserError, at_least_one, check_choice, whole
from ifo_grounding.seeding import STREAMS, derive
from ifo_grounding.tasks.goals import MAX_STEPS

MAX_STEPS_OF_OTHERS = 1000
"""Most actions in an environment that is given, whose episodes end by themselves mostly."""

Player = Callable[..., Outcomes]
"""Plays an environment from what its reset returned; takes ``on_step`` as :func:`play` does."""
PlayBatch = Callable[[Player, EnvBase, TensorDictBase], Iterable[Tensor]]
"""Plays a batch of scenes and returns columns, [B, ...] each."""


def play_scenes(
    policy: Policy,
    env_or_task: EnvBase | str,
    numbers: Sequence[int],
    play_batch: PlayBatch,
    *,
    mode: str = "greedy",
    seed: int = 0,
    stream: str = "evaluation",
    batch_size: int = 1000,
    max_steps: int | None = None,
    purpose: str = "success",
    **env_options: Any,
) -> tuple[list[Tensor], str]:
    """Play one episode per scene, batch by batch, in eval mode and without gradients.

    Args:
        env_or_task: as for :func:`~ifo_grounding.evaluation.success_rate`, and so are the arguments
            that are not named here.
        numbers: which scenes of the stream. Environments that are neither the library's nor of
            :func:`~ifo_grounding.envs.from_gymnasium` are seeded before each batch and have only
            the first ones, ``range(n)``.
        purpose: names the random numbers that sampled actions are drawn with.

    Returns:
        The columns of ``play_batch``, of all scenes [N, ...] on the CPU, and the hash of the
        scenes' first frames and instructions.
    """
    if whole("seed", seed) < 0:  # which a generator of TorchRL does not take
        raise UserError(f"the seed of scenes must be at least 0, got {seed}")
    if isinstance(env_or_task, str):
        limit = MAX_STEPS if max_steps is None else at_least_one("max_steps", max_steps)
        env: EnvBase = PickAndPlaceEnv(
            env_or_task,
            num_envs=min(at_least_one("batch_size", batch_size), len(numbers)),
            seed=seed,
            stream=stream,
            max_steps=limit,
            **{"device": modules.device_of(policy), **env_options},
        )
        batches = _numbered(env, numbers)
    else:
        limit = MAX_STEPS_OF_OTHERS if max_steps is None else at_least_one("max_steps", max_steps)
        batches = _batches_of(env_or_task, numbers, seed, stream, env_options)
    player = functools.partial(play, policy, mode=mode, max_steps=limit)
    parts, pixels, instructions = [], hashlib.blake2b(), hashlib.blake2b()
    for batch, (env, start, count) in enumerate(batches):
        first = start.reshape(start.batch_size.numel())[:count]
        pixels.update(first[keys.PIXELS].cpu().numpy().tobytes())
        instructions.update(first[keys.INSTRUCTION].cpu().numpy().astype("<i8").tobytes())
        home = start[keys.PIXELS].device
        cuda = [home] if home.type == "cuda" else []
        with modules.evaluating(policy), torch.random.fork_rng(devices=cuda):
            torch.manual_seed(derive(seed, purpose, mode, batch))
            parts.append([column[:count].cpu() for column in play_batch(player, env, start)])
    both = pixels.digest() + instructions.digest()
    columns = [torch.cat(column) for column in zip(*parts, strict=True)]
    return columns, hashlib.blake2b(both, digest_size=8).hexdigest()


def _numbered(
    env: EnvBase, numbers: Sequence[int]
) -> Iterator[tuple[EnvBase, TensorDictBase, int]]:
    """Yield an environment, what its reset to scenes returned, and how many of its rows count."""
    rows = env.batch_size.numel()
    for chosen in torch.as_tensor(numbers, device=env.device).split(rows):
        yield env, begin(env, chosen), len(chosen)


def _batches_of(
    env: EnvBase, numbers: Sequence[int], seed: int, stream: str, env_options: dict[str, Any]
) -> Iterator[tuple[EnvBase, TensorDictBase, int]]:
    """Yield batches as :func:`_numbered` does, in an environment that is given."""
    _check_given(env, env_options)
    if isinstance(env, GymnasiumEnv | PickAndPlaceEnv):
        check_choice("stream", stream, STREAMS)
        kept, env.stream = env.stream, stream
        env.set_seed(seed)
        try:
            yield from _numbered(env, numbers)
        finally:
            env.stream = kept
        return
    if list(numbers) != [*range(len(numbers))]:
        raise UserError(
            "this environment cannot be reset to a scene by its number: ask for the first ones, "
            "range(n), name a task, or give a PickAndPlaceEnv or one of from_gymnasium as it is"
        )
    rows = env.batch_size.numel()
    for batch, first in enumerate(range(0, len(numbers), rows)):
        env.set_seed(derive(seed, stream, batch) % 2**31)
        yield env, env.reset(), min(rows, len(numbers) - first)


def _check_given(env: EnvBase, env_options: dict[str, Any]) -> None:
    """Refuse an environment in which success cannot be measured."""
    if env_options:
        raise UserError(
            f"options {sorted(env_options)} are for an environment made from a task's name: "
            "give them to your environment"
        )
    if attribute(env, "instructed") is False:
        raise UserError(
            "an environment made with instructed=False pays no true reward, whatever chooses its "
            "instructions: evaluate in one with instructed=True"
        )
    shown = env.observation_spec.keys(True, True)
    for key, what in ((keys.INSTRUCTION, "instruction"), (keys.PIXELS, "image")):
        if key not in shown:
            raise UserError(
                f"success needs an environment that shows its {what} under {key!r}: make it with "
                "instructed=True, or rename its entry with torchrl.envs.RenameTransform"
            )
    if len(env.reward_keys) > 1 and keys.REWARD not in env.reward_keys:
        raise UserError(
            f"the environment pays {env.reward_keys}: success is seen from the true reward, named "
            f"{keys.REWARD!r}"
        )
