"""Episodes to look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.evaluation.episodes import (
    MAX_STEPS,
    Policy,
    device_of,
    play,
    scene_batches,
    seeded,
)
from ifo_grounding.modules import evaluating
from ifo_grounding.seeding import derive
from ifo_grounding.tasks.vocabulary import VOCABULARY


@dataclass(frozen=True)
class Episode:
    """One episode to look at."""

    frames: np.ndarray
    """What was seen, uint8 [T + 1, 3, H, W]."""
    actions: np.ndarray
    """What was done, int64 [T]."""
    sentence: str
    """The instruction."""
    success: bool
    """Whether it was fulfilled at the end."""
    stopped: bool
    """Whether the policy stopped by itself."""
    scene: int
    """Number of the scene in its stream."""


def record_episodes(
    policy: Policy,
    task: str,
    scenes: Sequence[int] = range(8),
    *,
    seed: int = 0,
    stream: str = "evaluation",
    mode: str = "greedy",
    max_steps: int = MAX_STEPS,
    render_tile_size: int | None = None,
    device: torch.device | str | None = None,
    **env_options: Any,
) -> list[Episode]:
    """Play the scenes with the given numbers and keep their frames.

    Scenes are those of :func:`success_rate` with the same seed and stream: scene ``i`` is its
    ``outcomes[i]``.

    Args:
        policy: writes an action.
        task: name of the task.
        scenes: numbers of the scenes.
        seed: of the stream.
        stream: ``training``, ``validation`` or ``evaluation``.
        mode: ``greedy`` or ``sampled``.
        max_steps: most actions per episode.
        render_tile_size: size of a cell in the kept frames, for people (16 or 32); what the policy
            sees where None.
        device: where to run; the policy's by default.
        env_options: further arguments of :class:`~ifo_grounding.envs.PickAndPlaceEnv`.

    >>> stop = lambda td: td.set("action", torch.full(td.shape, 5))
    >>> episode = record_episodes(stop, "move", [3])[0]
    >>> episode.frames.shape, episode.actions.tolist(), episode.stopped
    ((2, 3, 48, 48), [5], True)
    """
    if not len(scenes):
        return []
    where = torch.device(device) if device is not None else device_of(policy)
    options = {"batch_size": len(scenes), "device": where, "max_steps": max_steps, **env_options}
    env, start, _ = next(scene_batches(task, scenes, seed=seed, stream=stream, **options))

    def look() -> np.ndarray:
        assert isinstance(env, PickAndPlaceEnv)
        tile_size = env.tile_size if render_tile_size is None else render_tile_size
        return env.render(tile_size).transpose(0, 3, 1, 2)

    frames = [[frame] for frame in look()]
    actions: list[list[int]] = [[] for _ in scenes]
    sentences = VOCABULARY.decode(start[keys.INSTRUCTION].cpu())

    def keep(rows: Tensor, transition: TensorDictBase) -> None:
        seen = look()
        taken = transition[keys.ACTION].tolist()
        for row, action in zip(rows.tolist(), taken, strict=True):
            frames[row].append(seen[row])
            actions[row].append(action)

    with evaluating(policy), seeded(derive(seed, "record", mode), where):
        outcomes = play(policy, env, start, mode=mode, max_steps=max_steps, on_step=keep)
    return [
        Episode(
            frames=np.stack(frames[row]),
            actions=np.array(actions[row]),
            sentence=sentences[row],
            success=bool(outcomes.success[row]),
            stopped=bool(outcomes.stopped[row]),
            scene=int(number),
        )
        for row, number in enumerate(scenes)
    ]
