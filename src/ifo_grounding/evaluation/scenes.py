"""Scenes by number, their hash, and one episode of each."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding import keys, modules
from ifo_grounding.attributes import attribute
from ifo_grounding.envs import GymnasiumEnv, PickAndPlaceEnv
from ifo_grounding.episodes import Policy
from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.seeding import STREAMS, derive

MAX_STEPS = 40
MAX_STEPS_OF_OTHERS = 1000
"""Most actions in an environment that is given, whose episodes end by themselves mostly."""


def device_of(module: object) -> torch.device:
    """Return the device of a module's first parameter or buffer, else the CPU."""
    return modules.device_of(module) or torch.device("cpu")


@contextlib.contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Seed torch's global generators within a block and restore them after it."""
    cuda = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(devices=cuda):
        torch.manual_seed(seed)
        yield


def most_steps(env_or_task: EnvBase | str, max_steps: int | None) -> int:
    """Return the most actions of an episode: as said, or those of a task or of an environment."""
    if max_steps is not None:
        return at_least_one("max_steps", max_steps)
    return MAX_STEPS if isinstance(env_or_task, str) else MAX_STEPS_OF_OTHERS


class SceneHash:
    """Hash of the first frames and instructions of scenes, whatever batches they come in."""

    def __init__(self) -> None:
        self._pixels, self._instructions = hashlib.blake2b(), hashlib.blake2b()

    def update(self, start: TensorDictBase, scenes: int) -> None:
        """Add the first ``scenes`` rows of what a reset returned."""
        flat = start.reshape(start.batch_size.numel())[:scenes]
        self._pixels.update(flat[keys.PIXELS].cpu().contiguous().numpy().tobytes())
        instructions = flat[keys.INSTRUCTION].cpu().contiguous().numpy()
        self._instructions.update(instructions.astype("<i8").tobytes())

    def hexdigest(self) -> str:
        """Return 16 hexadecimal digits."""
        both = self._pixels.digest() + self._instructions.digest()
        return hashlib.blake2b(both, digest_size=8).hexdigest()


def scene_batches(
    env_or_task: EnvBase | str,
    numbers: Sequence[int],
    *,
    seed: int,
    stream: str,
    batch_size: int,
    device: torch.device,
    max_steps: int = MAX_STEPS,
    **env_options: Any,
) -> Iterator[tuple[EnvBase, TensorDictBase, int]]:
    """Yield environments reset to the scenes with the given numbers, batch by batch.

    Args:
        env_or_task: name of a task, or an instructed environment to use as it is, seeded anew so
            that its scenes depend on ``seed`` and nothing else. Those of
            :func:`~ifo_grounding.envs.from_gymnasium` have numbers; of others, which are seeded
            before each batch, there are only the first ones.
        numbers: which scenes of the stream.
        seed: of the stream.
        stream: ``training``, ``validation`` or ``evaluation``.
        batch_size: rows of an environment made here.
        device: of an environment made here.
        max_steps: of an environment made here.
        env_options: further arguments of :class:`~ifo_grounding.envs.PickAndPlaceEnv`.

    Yields:
        The environment, what its reset returned, and how many of its rows count.
    """
    env: EnvBase
    if isinstance(env_or_task, str):
        rows = min(at_least_one("batch_size", batch_size), len(numbers))
        env = PickAndPlaceEnv(
            env_or_task,
            num_envs=rows,
            device=device,
            seed=seed,
            stream=stream,
            max_steps=max_steps,
            **env_options,
        )
    else:
        env, rows = env_or_task, env_or_task.batch_size.numel()
        _check_given(env, env_options)
        if not isinstance(env, GymnasiumEnv):
            if list(numbers) != [*range(len(numbers))]:
                raise UserError(
                    "this environment cannot be reset to a scene by its number: ask for the first "
                    "ones, range(n), name a task, or use from_gymnasium"
                )
            yield from _batches_of(env, len(numbers), seed, stream)
            return
        check_choice("stream", stream, STREAMS)
        kept, env.stream = env.stream, stream
        env.set_seed(seed)
        try:
            yield from _numbered(env, rows, torch.as_tensor(numbers, device=device))
        finally:
            env.stream = kept
        return
    yield from _numbered(env, rows, torch.as_tensor(numbers, device=device))


def _numbered(
    env: EnvBase, rows: int, wanted: Tensor
) -> Iterator[tuple[EnvBase, TensorDictBase, int]]:
    for chosen in wanted.split(rows):
        # The last batch is filled up with copies of its first scene, which do not count.
        padded = torch.cat([chosen, chosen[:1].expand(rows - len(chosen))])
        scene = TensorDict(
            {keys.SCENE: padded.unsqueeze(-1)}, batch_size=[rows], device=wanted.device
        )
        yield env, env.reset(scene), len(chosen)


def play_scenes(
    policy: Policy,
    batches: Iterable[tuple[EnvBase, TensorDictBase, int]],
    seed: int,
    mode: str,
    play_batch: Callable[[EnvBase, TensorDictBase], Iterable[Tensor]],
) -> tuple[list[Tensor], str]:
    """Play batch after batch in eval mode, each with its own seed.

    Args:
        policy: which plays.
        batches: from :func:`scene_batches`.
        seed: of the actions, where sampled.
        mode: ``greedy`` or ``sampled``.
        play_batch: plays an environment from what its reset returned; tensors of its rows [B, ...].

    Returns:
        What ``play_batch`` returned, of all scenes [N, ...] on the CPU, and the scenes' hash.
    """
    scenes, parts = SceneHash(), []
    for number, (env, start, count) in enumerate(batches):
        scenes.update(start, count)
        device = start[keys.PIXELS].device
        with modules.evaluating(policy), seeded(derive(seed, "success", mode, number), device):
            parts.append([column[:count].cpu() for column in play_batch(env, start)])
    return [torch.cat(column) for column in zip(*parts, strict=True)], scenes.hexdigest()


def _check_given(env: EnvBase, env_options: dict[str, Any]) -> None:
    """Refuse an environment that cannot be judged as asked for."""
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
    if keys.INSTRUCTION not in shown:
        raise UserError(
            "success needs an environment that shows its instruction under "
            f"{keys.INSTRUCTION!r}: make it with instructed=True, or rename its entry with "
            "torchrl.envs.RenameTransform"
        )
    if keys.PIXELS not in shown:
        raise UserError(
            f"success needs an environment that shows its image under {keys.PIXELS!r}: rename its "
            "entry with torchrl.envs.RenameTransform"
        )
    if len(env.reward_keys) > 1 and keys.REWARD not in env.reward_keys:
        raise UserError(
            f"the environment pays {env.reward_keys}: success is seen from the true reward, named "
            f"{keys.REWARD!r}"
        )


def _batches_of(
    env: EnvBase, count: int, seed: int, stream: str
) -> Iterator[tuple[EnvBase, TensorDictBase, int]]:
    rows = env.batch_size.numel()
    for batch, first in enumerate(range(0, count, rows)):
        env.set_seed(derive(seed, stream, batch) % 2**31)
        yield env, env.reset(), min(rows, count - first)
