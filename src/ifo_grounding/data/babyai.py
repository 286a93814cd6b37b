"""Demonstrations of BabyAI's bot, and its levels as pictures; needs the extra ``babyai``."""

from __future__ import annotations

import functools
import itertools
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from io import StringIO
from multiprocessing import get_context
from types import SimpleNamespace
from typing import Any, Literal, cast, overload

import gymnasium
import numpy as np
import torch
from torch import Tensor

from ifo_grounding.cluster import spread
from ifo_grounding.data._episodes import Episode
from ifo_grounding.data.codec import TILE_SIZES
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.truth import Truth
from ifo_grounding.envs.wrapping import world_seed
from ifo_grounding.errors import UserError, at_least_one, check_choice, optional
from ifo_grounding.progress import progress_bar
from ifo_grounding.seeding import STREAMS, derive
from ifo_grounding.tasks.vocabulary import Vocabulary

BABYAI_ACTIONS = ("left", "right", "forward", "pickup", "drop", "toggle", "done")
"""MiniGrid's actions."""
DONE = BABYAI_ACTIONS.index("done")
"""The action that does nothing: how a policy says that it is done."""
PATIENCE = 3
"""How many times as many episodes as asked for are played before the bot counts as unable."""
ENDINGS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a recording, which processes side by side leave to their parent."""

Make = Callable[[], gymnasium.Env]


@functools.cache
def babyai_tiles(tile_size: int) -> Tensor:
    """Return all that a cell of BabyAI's can look like, uint8 [K, 3, tile_size, tile_size]."""
    from minigrid.core.grid import Grid

    drawn = [Grid.render_tile(*look, tile_size=tile_size) for look in _looks()]
    return torch.from_numpy(np.stack(drawn).astype(np.uint8)).permute(0, 3, 1, 2).contiguous()


@functools.cache
def _looks() -> list[tuple[Any, int | None]]:
    """Return what a cell can show: a thing or none, and the agent's direction or none."""
    from minigrid.core import world_object as kinds
    from minigrid.core.constants import COLOR_NAMES

    things: list[Any] = [None, kinds.Wall(), kinds.Goal(), kinds.Lava()]
    for color in COLOR_NAMES:
        things += [kind(color) for kind in (kinds.Floor, kinds.Key, kinds.Ball, kinds.Box)]
        things += [kinds.Door(color, is_open=True), kinds.Door(color)]
        things += [kinds.Door(color, is_locked=True)]
    under = [thing for thing in things if thing is None or thing.can_overlap()]
    facing = [(thing, direction) for thing in under for direction in range(4)]
    return [*((thing, None) for thing in things), *facing]


@functools.cache
def _numbers() -> dict[Any, int]:
    """Return the number of the tile of each look."""
    return {(thing and thing.encode(), seen): n for n, (thing, seen) in enumerate(_looks())}


def _number(thing: Any, agent_dir: int | None = None) -> int:
    """Return the number of the tile that shows a thing, and the agent on it."""
    return _numbers()[thing and thing.encode(), agent_dir]


def babyai(level: str, tile_size: int = 8, mission: str = "ends", codes: bool = False) -> Make:
    """Return a function that makes a level of BabyAI whose whole room is seen as a picture.

    What the agent carries is seen in the top left corner, so that a picture shows all there is.

    Args:
        level: such as ``GoToObj``, ``GoToLocal`` or ``PickupLoc``, or a full id.
        tile_size: pixels along one side of a cell.
        mission: what becomes of a room whose mission is fulfilled. It ``ends`` and pays, as BabyAI
            has it; it ``waits`` until the policy is done, and then pays, also where the policy has
            undone the mission since; or there is ``none``, and the room goes on, for a learner
            that chooses its instructions itself.
        codes: whether, in place of pixels, to show numbers of the room's ``tiles``, int16 [h, w].

    Raises:
        UserError: where minigrid is missing, or there is no such level.
    """
    check_choice("mission", mission, ("ends", "waits", "none"))
    name = level if level.endswith(("-v0", "-v1")) else f"BabyAI-{level}-v0"
    optional("minigrid", extra="babyai")  # registers the levels
    if name not in gymnasium.registry:
        ids = (each for each in gymnasium.registry if each.startswith("BabyAI-"))
        check_choice("level", level, sorted(each[7:-3] for each in ids))
    return functools.partial(_Room, name, tile_size, mission, codes)


class _Room(gymnasium.Wrapper):
    """Shows a level's whole room, and keeps it from printing whenever it draws a room anew."""

    def __init__(self, name: str, tile_size: int, mission: str, codes: bool) -> None:
        # The observation is another than the one declared, which the checker would refuse.
        super().__init__(gymnasium.make(f"minigrid:{name}", disable_env_checker=True))
        self.tile_size, self.mission, self._earned = tile_size, mission, 0.0
        self.level = level = cast(Any, self.unwrapped)
        # In place of what the agent sees, whose computation takes longer than all else.
        level.gen_obs = self._look
        size = (level.height * tile_size, level.width * tile_size, 3)
        image: gymnasium.Space = gymnasium.spaces.Box(0, 255, size, np.uint8)
        self.codes = codes
        if codes:
            self.tiles = babyai_tiles(tile_size)
            kinds = np.full((level.height, level.width), len(self.tiles))
            image = gymnasium.spaces.MultiDiscrete(kinds, dtype=np.int16)
        words = level.observation_space["mission"]
        self.observation_space = gymnasium.spaces.Dict({"image": image, "mission": words})

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        self._earned = 0.0
        with redirect_stdout(StringIO()):
            seen, info = self.env.reset(**options)
        if self.mission == "none":
            # In place of the mission, one of no words that no action fulfils.
            self.level.instrs = SimpleNamespace(verify=str, update_objs_poss=list)
            self.level.mission = self.level.surface = seen["mission"] = ""
        return seen, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take an action; a room that does not end with its mission ends with its time."""
        seen, reward, terminated, truncated, info = self.env.step(action)
        if self.mission == "ends":
            return seen, float(reward), terminated, truncated, info
        self._earned = max(self._earned, float(reward))
        pays = self.mission == "waits" and (int(action) == DONE or truncated)
        return seen, self._earned if pays else 0.0, False, truncated, info

    def _look(self) -> dict[str, Any]:
        """Show the room and what is carried, uint8 [H, W, 3] or codes, beside the mission."""
        grid, size = self.level.grid, self.tile_size
        draw: Any = _number
        if not self.codes:
            draw = functools.partial(grid.render_tile, tile_size=size)  # keeps what it has drawn
        tiles = [draw(cell) for cell in grid.grid]
        column, row = map(int, self.level.agent_pos)
        here = row * grid.width + column
        tiles[here] = draw(grid.grid[here], agent_dir=self.level.agent_dir)
        if self.level.carrying is not None:
            tiles[0] = draw(self.level.carrying)
        if self.codes:
            codes = np.array(tiles, np.int16).reshape(grid.height, grid.width)
            return {"image": codes, "mission": self.level.mission}
        pixels = np.concatenate(tiles).astype(np.uint8)
        cells = pixels.reshape(grid.height, grid.width, size, size, 3)
        image = cells.swapaxes(1, 2).reshape(grid.height * size, grid.width * size, 3)
        return {"image": image, "mission": self.level.mission}


Played = tuple[np.ndarray, str, list[int]]
"""What the bot did in a room: frames, uint8 [T + 1, 3, H, W], the last one repeated; the mission;
and its actions, the stop included, [T]."""


@overload
def record_babyai(
    level: str, n: int, *, keep_truth: Literal[False] = ..., **options: Any
) -> Demonstrations: ...
@overload
def record_babyai(
    level: str, n: int, *, keep_truth: Literal[True], **options: Any
) -> tuple[Demonstrations, Truth]: ...
def record_babyai(  # type: ignore[misc]  # the overloads leave options open
    level: str,
    n: int,
    *,
    keep_truth: bool = False,
    seed: int = 0,
    stream: str = "training",
    tile_size: int = 8,
    processes: int = 1,
    vocabulary: Vocabulary | None = None,
    progress: bool = False,
) -> Demonstrations | tuple[Demonstrations, Truth]:
    """Record BabyAI's bot: frames and missions, never actions.

    The bot's own end is followed by one repeated frame, the stop. Episodes that it does not solve
    are left out. The rooms are none of those that :func:`~ifo_grounding.envs.from_gymnasium` shows.

    Args:
        level: of BabyAI, see :func:`babyai`.
        keep_truth: whether to return the bot's actions too, for evaluation only.
        processes: how many record side by side; with several, a script needs its
            ``if __name__ == "__main__":``, and where ``RAY_ADDRESS`` names a Ray cluster, all its
            processors record.
        vocabulary: the words of the missions; by default those that occur.

    Raises:
        UserError: where minigrid is missing, there is no such level, or the bot fails too often.
    """
    n, processes = at_least_one("n", n), at_least_one("processes", processes)
    name = f"{level.removeprefix('BabyAI-').removesuffix('-v0')} {stream}"
    seeds = (derive(seed, "babyai", name, number) % 2**31 for number in range(PATIENCE * n))
    make = babyai(level, tile_size)
    actions: list[int] = []

    def episodes() -> Iterator[Episode]:
        solved = filter(None, _played(make, seeds, processes))
        shown = progress_bar(itertools.islice(solved, n), f"record {level}", n, shown=progress)
        count = 0
        for count, (frames, mission, taken) in enumerate(shown, start=1):
            actions.extend(taken)
            yield count - 1, frames, mission
        if count < n:
            raise UserError(
                f"the bot solved {count} of {PATIENCE * n} episodes of {level}: choose a level "
                "that it can solve"
            )

    demos = Demonstrations.from_episodes(
        episodes(),
        vocabulary=vocabulary,
        tile_size=tile_size if tile_size in TILE_SIZES else None,
        close=False,
    )
    return (demos, Truth(torch.tensor(actions, dtype=torch.uint8))) if keep_truth else demos


def bot_outcomes(
    level: str, episodes: int, *, seed: int = 0, stream: str = "evaluation", processes: int = 1
) -> Tensor:
    """Return whether BabyAI's bot fulfils its mission in each of the rooms of a stream, bool [N].

    The rooms are those that :func:`~ifo_grounding.envs.from_gymnasium` shows by their numbers, with
    the same seed and stream; other arguments, and errors, are those of :func:`record_babyai`.
    """
    check_choice("stream", stream, STREAMS)
    episodes, processes = at_least_one("episodes", episodes), at_least_one("processes", processes)
    seeds = (world_seed(seed, stream, number) for number in range(episodes))
    return torch.tensor([one is not None for one in _played(babyai(level), seeds, processes)])


def _played(make: Make, seeds: Iterator[int], processes: int) -> Iterator[Played | None]:
    """Yield what the bot did in the room of each seed, in order, played no further than needed."""
    play = functools.partial(_play, make)
    if processes == 1:
        yield from map(play, seeds)
        return
    if os.environ.get("RAY_ADDRESS"):
        yield from spread(play, seeds)
        return
    # Fresh processes: forked ones would inherit torch's threads.
    with ProcessPoolExecutor(processes, get_context("spawn"), _heed_the_parent) as pool:
        while some := list(itertools.islice(seeds, 16 * processes)):
            signal.pthread_sigmask(signal.SIG_BLOCK, ENDINGS)  # new processes inherit it
            try:
                found = pool.map(play, some)
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDINGS)
            yield from found


def _heed_the_parent() -> None:
    """Let the parent end this process where a signal reaches both, or end after ten seconds."""
    for ending in ENDINGS:
        signal.signal(ending, lambda *_: signal.alarm(10))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDINGS)


def _play(make: Make, seed: int) -> Played | None:
    """Let the bot play a room; None where it does not succeed."""
    from minigrid.utils.baby_ai_bot import BabyAIBot

    env = make()
    observation, _ = env.reset(seed=seed)
    bot = BabyAIBot(env.unwrapped)
    frames, actions, action, ended = [observation["image"]], [], None, False
    while not ended:
        try:
            action = bot.replan(action)
        except Exception:  # some rooms are beyond it, and it says so in many ways
            return None
        seen, reward, terminated, truncated, _ = env.step(action)
        ended = terminated or truncated
        frames.append(seen["image"])
        actions.append(int(action))
    if not reward:
        return None
    pictures = np.stack([*frames, frames[-1]]).transpose(0, 3, 1, 2)  # with the stop
    return pictures, str(observation["mission"]), [*actions, DONE]
