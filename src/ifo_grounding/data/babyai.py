"""Demonstrations of BabyAI's bot, and its levels as pictures; needs the extra ``babyai``."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from io import StringIO
from multiprocessing import get_context
from typing import Any

import gymnasium
import numpy as np
import torch
from tqdm import tqdm

from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import derive
from ifo_grounding.tasks.vocabulary import Vocabulary

DONE = 6
"""MiniGrid's action that does nothing: how a policy says that it is done."""
LENGTH = 32
"""Words of the longest mission of one room."""
PATIENCE = 3
"""How many times as many episodes as asked for are played before the bot counts as unable."""

Episode = tuple[np.ndarray, str]


def babyai(level: str, tile_size: int = 8) -> Callable[[], gymnasium.Env]:
    """Return a function that makes a level of BabyAI whose whole room is seen as a picture.

    Args:
        level: such as ``GoToObj``, ``GoToLocal`` or ``PickupLoc``, or a full id.
        tile_size: pixels along one side of a cell.

    Raises:
        UserError: where minigrid is missing, or there is no such level.
    """
    name = level if level.endswith(("-v0", "-v1")) else f"BabyAI-{level}-v0"
    try:
        import minigrid  # noqa: F401  (registers the levels)
    except ImportError:
        raise UserError("BabyAI needs minigrid: pip install 'ifo-grounding[babyai]'") from None
    if name not in gymnasium.registry:
        known = sorted(i[7:-3] for i in gymnasium.registry if i.startswith("BabyAI-"))
        raise UserError(f"there is no level {name!r}: choose among {', '.join(known)}")
    return functools.partial(_make, name, tile_size)


def _make(name: str, tile_size: int) -> gymnasium.Env:
    import minigrid  # noqa: F401
    from minigrid.wrappers import RGBImgObsWrapper

    return RGBImgObsWrapper(_Quiet(gymnasium.make(name)), tile_size=tile_size)


class _Quiet(gymnasium.Wrapper):
    """Keeps a level from printing whenever it draws a room anew."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        with redirect_stdout(StringIO()):
            return self.env.reset(**options)


def record_babyai(
    level: str,
    n: int,
    *,
    seed: int = 0,
    stream: str = "training",
    tile_size: int = 8,
    processes: int = 1,
    vocabulary: Vocabulary | None = None,
    progress: bool = False,
) -> Demonstrations:
    """Record BabyAI's bot: frames and missions, never actions.

    The bot's own end is followed by one repeated frame, the stop. Episodes that it does not solve
    are left out.

    Args:
        level: of BabyAI, see :func:`babyai`.
        n: number of demonstrations.
        seed: of the stream of rooms, which are other ones than those of
            :func:`~ifo_grounding.envs.from_gymnasium`.
        stream: name of the stream.
        tile_size: pixels along one side of a cell.
        processes: how many record side by side.
        vocabulary: the words of the missions; by default those that occur.
        progress: whether to show a bar.

    Returns:
        Demonstrations of ``n`` episodes, closed.

    Raises:
        UserError: where minigrid is missing, there is no such level, or the bot fails too often.
    """
    if n < 1 or processes < 1:
        raise UserError(f"n and processes must be at least 1, got {n} and {processes}")
    play = functools.partial(_play, babyai(level, tile_size), seed, f"{level} {stream}")
    frames: list[np.ndarray] = []
    missions: list[str] = []
    with (
        tqdm(total=n, desc=f"record {level}", disable=not progress) as bar,
        _mapper(processes) as run,
    ):
        for episode in run(play, range(PATIENCE * n)):
            if episode is not None:
                frames.append(episode[0])
                missions.append(episode[1])
                bar.update()
            if len(frames) == n:
                break
    if len(frames) < n:
        raise UserError(
            f"the bot solved {len(frames)} of {PATIENCE * n} episodes of {level}: choose a level "
            "that it can solve"
        )
    words = vocabulary or Vocabulary.from_sentences(missions, LENGTH)
    shown = (torch.from_numpy(part) for part in frames)
    return Demonstrations.from_arrays(shown, missions, vocabulary=words, tile_size=tile_size)


class _mapper:
    """``map`` over this process or several, in order and no further ahead than needed."""

    def __init__(self, processes: int) -> None:
        # Fresh processes: forked ones would inherit torch's threads.
        self.pool = (
            ProcessPoolExecutor(processes, mp_context=get_context("spawn"))
            if processes > 1
            else None
        )
        self.ahead = 16 * processes

    def __enter__(self) -> Callable[..., Any]:
        return self._run if self.pool else map

    def __exit__(self, *error: object) -> None:
        if self.pool:
            self.pool.shutdown(cancel_futures=True)

    def _run(self, play: Callable[[int], Any], numbers: range) -> Any:
        assert self.pool is not None
        waiting = [self.pool.submit(play, number) for number in numbers[: self.ahead]]
        for number in itertools.count(self.ahead):
            if not waiting:
                return
            yield waiting.pop(0).result()
            if number < len(numbers):
                waiting.append(self.pool.submit(play, number))


def _play(make: Callable[[], gymnasium.Env], seed: int, stream: str, number: int) -> Episode | None:
    """Let the bot play a room; None where it does not succeed."""
    from minigrid.utils.baby_ai_bot import BabyAIBot

    env = make()
    observation, _ = env.reset(seed=derive(seed, "babyai", stream, number) % 2**31)
    mission = str(observation["mission"])
    bot = BabyAIBot(env.unwrapped)
    frames, action = [observation["image"]], None
    while True:
        try:
            action = bot.replan(action)
        except Exception:  # some rooms are beyond it, and it says so in many ways
            return None
        observation, reward, terminated, truncated, _ = env.step(action)
        frames.append(observation["image"])
        if terminated or truncated:
            break
    if not reward:
        return None
    frames.append(frames[-1])  # the stop
    return np.stack(frames).transpose(0, 3, 1, 2), mission
