"""Episodes to look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.attributes import attribute
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.episodes import Policy, play
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation.scenes import device_of, most_steps, scene_batches, seeded
from ifo_grounding.modules import evaluating
from ifo_grounding.seeding import derive
from ifo_grounding.tasks.vocabulary import VOCABULARY, Vocabulary


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
    """Whether it terminated, before the limit of its length."""
    scene: int
    """Number of the scene in its stream."""


def record_episodes(
    policy: Policy,
    env_or_task: EnvBase | str,
    scenes: Sequence[int] = range(8),
    *,
    seed: int = 0,
    stream: str = "evaluation",
    mode: str = "greedy",
    max_steps: int | None = None,
    render_tile_size: int | None = None,
    device: torch.device | str | None = None,
    **env_options: Any,
) -> list[Episode]:
    """Play the scenes with the given numbers and keep their frames.

    Scenes are those of :func:`success_rate` with the same seed and stream: scene ``i`` is its
    ``outcomes[i]``.

    Args:
        policy: writes an action.
        env_or_task: name of a task, or an instructed environment with as many rows as scenes are
            asked for. Those of :func:`~ifo_grounding.envs.from_gymnasium` have numbers.
        scenes: numbers of the scenes; of other environments the first ones, ``range(n)``.
        seed: of the stream.
        stream: ``training``, ``validation`` or ``evaluation``.
        mode: ``greedy`` or ``sampled``.
        max_steps: most actions per episode, one that has not ended by then is a failure; by default
            40 for a task's name, and 1,000 in an environment, whose own limit may be lower.
        render_tile_size: size of a cell in the kept frames, for people (16 or 32), for a task's
            name; what the policy sees where None.
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
    options = {"batch_size": len(scenes), "device": where, **env_options}
    options["max_steps"] = limit = most_steps(env_or_task, max_steps)
    env, start, _ = next(scene_batches(env_or_task, scenes, seed=seed, stream=stream, **options))
    if env.batch_size.numel() != len(scenes):
        raise UserError(
            f"the environment has {env.batch_size.numel()} rows for {len(scenes)} scenes: make it "
            "with as many"
        )

    def look(shown: TensorDictBase) -> np.ndarray:
        if not isinstance(env, PickAndPlaceEnv):
            return shown.reshape(shown.batch_size.numel())[keys.PIXELS].cpu().numpy()
        tile_size = env.tile_size if render_tile_size is None else render_tile_size
        return env.render(tile_size).transpose(0, 3, 1, 2)

    frames = [[frame] for frame in look(start)]
    actions: list[list[int]] = [[] for _ in scenes]
    vocabulary: Vocabulary = attribute(env, "vocabulary", VOCABULARY)
    told = start.reshape(len(scenes))[keys.INSTRUCTION]
    sentences = vocabulary.decode(told.cpu())

    def keep(rows: Tensor, transition: TensorDictBase) -> None:
        # The grid is drawn as a whole, at the size for people; of others, the rows that moved.
        whole = isinstance(env, PickAndPlaceEnv)
        seen = look(transition[keys.NEXT])
        taken = transition[keys.ACTION].tolist()
        for place, (row, action) in enumerate(zip(rows.tolist(), taken, strict=True)):
            frames[row].append(seen[row if whole else place])
            actions[row].append(action)

    with evaluating(policy), seeded(derive(seed, "record", mode), where):
        outcomes = play(policy, env, start, mode=mode, max_steps=limit, on_step=keep)
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
