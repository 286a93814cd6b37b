"""Levels of BabyAI (MiniGrid), whose bot demonstrates and whose own reward is success."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING
from torch import Tensor

from ifo_grounding.data import Demonstrations, Truth, babyai, bot_outcomes, record_babyai
from ifo_grounding.data.babyai import BABYAI_ACTIONS, DONE, babyai_tiles
from ifo_grounding.envs import GymnasiumEnv, from_gymnasium
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.machine import cores
from ifo_grounding.mosaic import PIXELS_PER_WORD
from ifo_grounding.worlds.base import Tiled


@dataclass
class BabyAI(Tiled):
    """A level of BabyAI, its whole room seen as a picture; needs the extra ``babyai``."""

    level: str = MISSING
    """Such as ``GoToObj``, ``GoToLocal`` or ``PickupLoc``."""
    tile_size: int = 8
    """Pixels along one side of a cell."""
    processes: int | None = None
    """Processes that record the bot side by side; null: all cores that this one may use, or of the
    Ray cluster that ``RAY_ADDRESS`` names."""

    def __post_init__(self) -> None:
        babyai(self.level, self.tile_size)  # refuses what is no level
        self.actions, self.stop_action = BABYAI_ACTIONS, DONE

    def simulator(self, num_envs: int, *, codes: bool = False, **options: Any) -> GymnasiumEnv:
        """Return rooms without missions; see :class:`World`."""
        codes = codes and self.tiles is not None
        return self._rooms("none", num_envs, codes=codes, **options)

    @property
    def tiles(self) -> Tensor | None:  # type: ignore[override]
        """All that a cell can look like, where codes can be read."""
        return None if self.tile_size % PIXELS_PER_WORD else babyai_tiles(self.tile_size)

    def instructed(
        self, num_envs: int, *, split: str = "all", waits: bool = False, **options: Any
    ) -> GymnasiumEnv:
        """Return rooms with their missions, which end with them unless they are to wait."""
        check_choice("evaluate.split of BabyAI", split, ["all"])
        return self._rooms("waits" if waits else "ends", num_envs, **options)

    def demonstrate(self, n: int, **options: Any) -> tuple[Demonstrations, Truth | None]:
        """Let the bot demonstrate, and keep its actions apart."""
        options = {"tile_size": self.tile_size, "processes": self._processes, **options}
        return record_babyai(self.level, n, keep_truth=True, **options)

    def demonstrator(self, episodes: int, *, seed: int, stream: str) -> Tensor:
        """Return the bot's own success."""
        return bot_outcomes(
            self.level, episodes, seed=seed, stream=stream, processes=self._processes
        )

    @property
    def _processes(self) -> int:
        return self.processes or cores()

    def _rooms(
        self, mission: str, num_envs: int, codes: bool = False, **options: Any
    ) -> GymnasiumEnv:
        if self.vocabulary is None:
            raise UserError("record demonstrations first: they hold the words of the missions")
        return from_gymnasium(
            babyai(self.level, self.tile_size, mission, codes),
            vocabulary=self.vocabulary,
            num_envs=num_envs,
            instructed=mission != "none",
            stop=self.stop_action,
            skip_unknown=True,  # no demonstration taught them
            **options,
        )
