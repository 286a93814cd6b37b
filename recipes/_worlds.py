"""The worlds that recipes run in; the option `simulator` names one, `world` holds its settings."""

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from _shared import changed_networks, load_demonstrations, open_run, plain, shows_progress
from omegaconf import DictConfig
from torch import Tensor
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.data import (
    Demonstrations,
    Truth,
    babyai,
    bot_outcomes,
    load_pictures,
    record_babyai,
    record_demonstrations,
)
from ifo_grounding.data.babyai import BABYAI_ACTIONS, DONE
from ifo_grounding.data.listing import LIST
from ifo_grounding.envs import GymnasiumEnv, PickAndPlaceEnv, from_gymnasium
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.tasks import VOCABULARY, Vocabulary, grammar
from ifo_grounding.world import Layout

ROOMS = 256
"""Rooms of BabyAI that are played side by side."""
UNTIL_THE_END = {"max_steps": 10_000}
"""Rooms of BabyAI have time limits of their own."""
Played = tuple[EnvBase | str, dict[str, Any]]
"""Where to play instructed episodes, and how: arguments of the functions of `evaluation`."""


class Grid:
    """The library's own world, whose oracle knows what suits a scene and how an episode ended."""

    actions = keys.ACTIONS
    stop = keys.STOP
    oracle = True
    vocabulary: Vocabulary | None = VOCABULARY

    def __init__(self, options: DictConfig) -> None:
        self.options, self.task = options, options.task

    def arguments(self, **chosen: Any) -> dict[str, Any]:
        """Return the arguments that environments, recorder and oracle share."""
        settings = plain(self.options.world)
        layout: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in settings.pop("layout").items()
        }
        try:
            return {**settings, "layout": Layout(**layout), **chosen}
        except TypeError as error:
            raise UserError(f"world.layout is {dict(layout)}: {error}") from None

    def simulator(self, num_envs: int = 1) -> PickAndPlaceEnv:
        """Return the simulator without instructions and rewards: all that a learner may step."""
        return PickAndPlaceEnv(
            self.task,
            num_envs=num_envs,
            seed=self.options.seed,
            device=self.options.device,
            instructed=False,
            **self.arguments(),
        )

    def demonstrate(self, n: int, **chosen: Any) -> tuple[Demonstrations, Truth]:
        """Record demonstrations, and apart from them what only evaluation may read."""
        return record_demonstrations(self.task, n, keep_truth=True, **self.arguments(**chosen))

    def played(self, episodes: int, *, waits: bool = False, **chosen: Any) -> Played:
        """Return where to play instructed episodes; a fulfilled instruction ends none of them."""
        return self.task, {"episodes": episodes, **self.arguments(**chosen)}

    def pictured(self, scenes: list[int], **chosen: Any) -> Played:
        """Return where to record the episodes of scenes, to look at."""
        return self.task, {"scenes": scenes, "render_tile_size": 32, **self.arguments(**chosen)}

    def demonstrator(self, episodes: int, **chosen: Any) -> Tensor:
        """Return the demonstrator's own success in these episodes: the expert never fails."""
        return torch.ones(episodes, dtype=torch.bool)


class BabyAI:
    """A level of BabyAI (MiniGrid), whose bot demonstrates and whose own reward is success."""

    actions = BABYAI_ACTIONS
    stop = DONE
    oracle = False
    vocabulary: Vocabulary | None = None  # that of the demonstrations

    def __init__(self, options: DictConfig) -> None:
        self.options, self.level = options, options.task
        self.tile_size: int = options.world.tile_size
        self.processes: int = options.processes or os.cpu_count() or 1

    def simulator(self, num_envs: int = 1) -> GymnasiumEnv:
        """Return rooms without missions: all that a learner may step."""
        return self._rooms(num_envs, self.options.seed, "training", mission="none")

    def demonstrate(self, n: int, **chosen: Any) -> tuple[Demonstrations, Truth]:
        """Let the bot demonstrate, and keep its actions apart."""
        settings = {"tile_size": self.tile_size, "processes": self.processes, **chosen}
        return record_babyai(self.level, n, keep_truth=True, **settings)

    def played(
        self, episodes: int, *, seed: int, stream: str, split: str = "all", waits: bool = False
    ) -> Played:
        """Return rooms with their missions, which end with them unless they are to wait."""
        check_choice("evaluate.split of BabyAI", split, ["all"])
        mission = "waits" if waits else "ends"
        rooms = self._rooms(min(episodes, ROOMS), seed, stream, mission)
        return rooms, {"episodes": episodes, "seed": seed, "stream": stream, **UNTIL_THE_END}

    def pictured(self, scenes: list[int], *, seed: int, stream: str, **chosen: Any) -> Played:
        """Return where to record the episodes of rooms, to look at."""
        rooms = self._rooms(len(scenes), seed, stream)
        return rooms, {"scenes": scenes, "seed": seed, "stream": stream, **UNTIL_THE_END}

    def demonstrator(self, episodes: int, *, seed: int, stream: str, **chosen: Any) -> Tensor:
        """Return the bot's own success in these episodes."""
        return bot_outcomes(
            self.level, episodes, seed=seed, stream=stream, processes=self.processes, **chosen
        )

    @functools.cached_property
    def _words(self) -> Vocabulary:
        words = load_demonstrations(open_run(self.options)).vocabulary
        assert words is not None
        return words

    def _rooms(self, num_envs: int, seed: int, stream: str, mission: str = "ends") -> GymnasiumEnv:
        return from_gymnasium(
            babyai(self.level, self.tile_size, mission),
            vocabulary=self._words,
            num_envs=num_envs,
            instructed=mission != "none",
            stop=self.stop,
            skip_unknown=True,  # no demonstration taught them
            seed=seed,
            stream=stream,
            device=self.options.device,
        )


World = Grid | BabyAI
WORLDS: dict[str, type[World]] = {"grid": Grid, "babyai": BabyAI}


def open_world(options: DictConfig) -> World:
    """Return the world of these options."""
    check_choice("simulator", options.simulator, WORLDS)
    if options.simulator == "babyai" and "layout" in options.world:  # settings of the grid
        raise UserError("a level of BabyAI is chosen by world=babyai level=...")
    return WORLDS[options.simulator](options)


def read_recorded(options: DictConfig) -> Demonstrations:
    """Read demonstrations that were recorded elsewhere, the first ``demonstrations.n`` of them.

    Raises:
        UserError: where there are none, or they show another world than the simulator's.
    """
    folder, world = Path(options.recorded), open_world(options)
    if (folder / LIST).exists():
        demos = load_pictures(folder, vocabulary=world.vocabulary, progress=shows_progress(options))
    else:
        demos = Demonstrations.load(folder).close_episodes()
    if world.vocabulary and demos.vocabulary != world.vocabulary:
        raise UserError(
            f"instructions in {folder} have another vocabulary than the world: record them with "
            "vocabulary=ifo_grounding.tasks.VOCABULARY, or train with the Python functions"
        )
    if isinstance(world, Grid):  # others need the words of their demonstrations first
        shown = tuple(world.simulator().observation_spec[keys.PIXELS].shape[1:])
        if demos.image_shape != shown:
            raise UserError(
                f"frames in {folder} are {list(demos.image_shape)}, those of the simulator "
                f"{list(shown)}: set world.tile_size and world.layout.size as they were recorded"
            )
        try:
            grammar(world.task).parse_tokens(demos.pool())
        except UserError as error:
            raise UserError(f"{folder} is of another task: {error}; say task=...") from None
    return demos[: options.demonstrations.n]


def context_of(options: DictConfig, section: str) -> int:
    """Return over how many neighbouring cells a section's network sees, 0 where not said."""
    return options[section].get("context", 0)


def build(make: Callable[..., Any], options: DictConfig, **kwargs: Any) -> Any:
    """Build a network for the simulator's images, words and actions."""
    chosen = {"seed": options.seed, "device": options.device, **changed_networks(options), **kwargs}
    return make(open_world(options).simulator(), options.network, **chosen)
