"""Episodes to look at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.attributes import attribute
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.envs.base import NumberedEnv
from ifo_grounding.episodes import Outcomes, Policy
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation.scenes import Player, play_scenes
from ifo_grounding.tasks.vocabulary import VOCABULARY, Vocabulary


@dataclass(frozen=True)
class Episode:
    """One episode to look at."""

    frames: np.ndarray
    """What was seen, uint8 [T + 1, C, H, W]."""
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
    sentence: str | None = None,
    state: Any = None,
    render_tile_size: int | None = None,
    **options: Any,
) -> list[Episode]:
    """Play the scenes with the given numbers and keep their frames.

    Scene ``i`` is ``outcomes[i]`` of :func:`success_rate` with the same seed and stream.

    Args:
        env_or_task: name of a task, or an instructed environment with as many rows as scenes are
            asked for. Those of :func:`~ifo_grounding.envs.from_gymnasium` have numbers.
        scenes: numbers of the scenes; of other environments the first ones, ``range(n)``.
        sentence: what is asked in place of the scenes' own instructions, where the environment
            takes one, as the library's own world does.
        state: worlds [N] to begin in, in place of the scenes' own: a
            :class:`~ifo_grounding.world.WorldState`, in the library's own world.
        render_tile_size: size of a cell in the kept frames, for people (16 or 32), for a task's
            name; what the policy sees where None.
        options: of :func:`success_rate`, such as ``mode``, ``seed``, ``stream`` and ``max_steps``.

    Raises:
        UserError: where the environment has not one row for each scene, or does not take the
            sentence.

    >>> import torch
    >>> stop = lambda td: td.set("action", torch.full(td.shape, 5))
    >>> episode = record_episodes(stop, "move", [3])[0]
    >>> episode.frames.shape, episode.actions.tolist(), episode.stopped
    ((2, 3, 48, 48), [5], True)
    """
    if not len(scenes):
        return []
    frames: list[list[np.ndarray]] = []
    actions: list[list[int]] = [[] for _ in scenes]
    sentences: list[str] = []

    def play_batch(player: Player, env: EnvBase, start: TensorDictBase) -> Outcomes:
        rows = env.batch_size.numel()
        if rows != len(scenes):
            raise UserError(
                f"the environment has {rows} rows for {len(scenes)} scenes: make it with as many"
            )
        if sentence is not None or state is not None:
            start = _asked(env, scenes, sentence, state)
        first = start.reshape(rows)
        seen = _seen(env, torch.arange(rows), first, render_tile_size)
        frames.extend([frame] for frame in seen)
        vocabulary: Vocabulary = attribute(env, "vocabulary", VOCABULARY)
        sentences.extend(vocabulary.decode(first[keys.INSTRUCTION].cpu()))

        def keep(running: Tensor, transition: TensorDictBase) -> None:
            seen = _seen(env, running, transition[keys.NEXT], render_tile_size)
            taken = transition[keys.ACTION].tolist()
            for row, frame, action in zip(running.tolist(), seen, taken, strict=True):
                frames[row].append(frame)
                actions[row].append(action)

        return player(env, start, on_step=keep)

    (success, _, stopped), _ = play_scenes(
        policy, env_or_task, scenes, play_batch, **{"batch_size": len(scenes), **options}
    )
    return [
        Episode(
            frames=np.stack(frames[row]),
            actions=np.array(actions[row]),
            sentence=sentences[row],
            success=bool(success[row]),
            stopped=bool(stopped[row]),
            scene=int(number),
        )
        for row, number in enumerate(scenes)
    ]


def _asked(env: EnvBase, scenes: Sequence[int], sentence: str | None, state: Any) -> TensorDictBase:
    """Begin scenes anew with a sentence or worlds of one's own."""
    if not isinstance(env, NumberedEnv):
        raise UserError(f"{type(env).__name__} takes no sentence of one's own at its reset")
    if state is not None and not isinstance(env, PickAndPlaceEnv):
        raise UserError(f"{type(env).__name__} cannot be arranged: it begins as it begins")
    asked = TensorDict({keys.SCENE: torch.tensor([*scenes]).unsqueeze(-1)}, env.batch_size)
    if state is not None:
        asked["state"] = state
    if sentence is None:
        return env.reset(asked.to(env.device or "cpu"))
    asked[keys.INSTRUCTION] = env.vocabulary.encode([sentence]).expand(len(scenes), -1)
    start = env.reset(asked.to(env.device or "cpu"))
    if not torch.equal(start[keys.INSTRUCTION].cpu(), asked[keys.INSTRUCTION].cpu()):
        raise UserError(f"this world takes no sentence of one's own: {env.own_sentence}")
    return start


def _seen(env: EnvBase, rows: Tensor, shown: TensorDictBase, tile_size: int | None) -> np.ndarray:
    """Return frames of some rows, which ``shown`` is of, uint8 [R, C, H, W]; grids are drawn."""
    if not isinstance(env, PickAndPlaceEnv):
        return shown[keys.PIXELS].cpu().numpy()
    return env.render(tile_size or env.tile_size).transpose(0, 3, 1, 2)[rows.cpu().numpy()]
