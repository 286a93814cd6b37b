"""The library's own world, in which the paper's five tasks are set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import MISSING
from torch import Tensor, nn

from ifo_grounding import keys
from ifo_grounding.data import Demonstrations, Truth, record_demonstrations
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.envs.base import begin
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import Endings, SuitabilityResult, episode_endings, suitable_rate
from ifo_grounding.seeding import derive
from ifo_grounding.tasks import REASONS, VOCABULARY, grammar, verdict
from ifo_grounding.world import Layout
from ifo_grounding.worlds.base import Tiled


@dataclass
class Grid(Tiled):
    """Pick and place on a grid of 6x6 cells; its oracle knows what suits a scene.

    >>> Grid("pick").simulator(4, seed=0).batch_size
    torch.Size([4])
    """

    actions, stop_action = keys.ACTIONS, keys.STOP
    task: str = MISSING
    """``move``, ``move-udlr``, ``pick``, ``pick-out`` or ``pick-udlr``."""
    tile_size: int = 8
    """Pixels along one side of a cell: 8, 16 or 32."""
    split: str = "all"
    """Instructions of training scenes: ``all``, or ``train`` to leave out the pairs of
    ``holdout``."""
    holdout: str = "pairs-3"
    """Colour-shape pairs: ``pairs-1`` to ``pairs-4``, or ``validation-3``."""
    holdout_visible: bool = True
    """Whether held-out pairs are still seen in training scenes."""
    size: int = 6
    """Cells along one side."""
    objects: tuple[int, int] = (4, 8)
    """Fewest and most objects of a scene."""
    boxes: tuple[int, int] = (2, 4)
    """Fewest and most boxes of a scene."""
    inside: float = 0.35
    """Probability that an object begins in a box."""

    def __post_init__(self) -> None:
        grammar(self.task)
        self.layout = Layout(self.size, (*self.objects,), (*self.boxes,), self.inside)
        self.vocabulary, self.oracle = VOCABULARY, self

    def scenes(self, **chosen: Any) -> dict[str, Any]:
        """Return the arguments that environments, recorder and oracle share."""
        names = ("tile_size", "split", "holdout", "holdout_visible", "layout")
        return {**{name: getattr(self, name) for name in names}, **chosen}

    def simulator(self, num_envs: int, **options: Any) -> PickAndPlaceEnv:
        """Return worlds without instructions and true rewards; see :class:`World`."""
        return PickAndPlaceEnv(self.task, num_envs, instructed=False, **self.scenes(**options))

    def instructed(
        self, num_envs: int, *, split: str = "all", waits: bool = False, **options: Any
    ) -> PickAndPlaceEnv:
        """Return worlds with an instruction; a fulfilled one ends no episode."""
        return PickAndPlaceEnv(self.task, num_envs, **self.scenes(split=split, **options))

    def demonstrate(self, n: int, **options: Any) -> tuple[Demonstrations, Truth | None]:
        """Record the expert."""
        return record_demonstrations(self.task, n, keep_truth=True, **self.scenes(**options))

    def demonstrator(self, episodes: int, *, seed: int, stream: str) -> Tensor:
        """Return the expert's success: it never fails."""
        return torch.ones(episodes, dtype=torch.bool)

    def steppable(self, num_envs: int, *, seed: int, **options: Any) -> PickAndPlaceEnv:
        """Return worlds that begin where demonstrations of this seed began; see :class:`World`."""
        return PickAndPlaceEnv(
            self.task, num_envs, seed=derive(seed, "demonstrations"), **self.scenes(**options)
        )

    def read(self, folder: str | Path, progress: bool = False) -> Demonstrations:
        """Read demonstrations that were recorded elsewhere, of this task."""
        demos = super().read(folder, progress)
        try:
            grammar(self.task).parse_tokens(demos.pool())
        except UserError as error:
            raise UserError(f"{folder} is of another task: {error}; say task=...") from None
        return demos

    def suitable_rate(self, classifier: Any, pool: Tensor, **options: Any) -> SuitabilityResult:
        """Check the instructions that a classifier chooses for fresh states."""
        return suitable_rate(classifier, self.task, pool, **self.scenes(**options))

    def endings(self, policy: nn.Module, episodes: int, **scenes: Any) -> Endings:
        """Say how the policy's episodes end."""
        options = self.scenes(episodes=episodes, **scenes)
        return episode_endings(policy, self.task, **options)

    def suits(
        self, instruction: Tensor, scene: int, *, seed: int, stream: str, state: Any = None
    ) -> str:
        """Say whether an instruction suits a scene or a state, ``suitable``, or why not."""
        if state is None:
            env = self.instructed(1, seed=seed, stream=stream)
            begin(env, torch.tensor([scene]))
            state = env.truth.state
        goal = grammar(self.task).parse_tokens(instruction.reshape(1, -1))
        return REASONS[int(verdict(state, goal))]


class OpenGrid(Tiled):
    """The same grid with sentences of a person's own, of which nobody knows what fulfils them."""

    actions, stop_action = keys.ACTIONS, keys.STOP
    rewarded = False

    def simulator(self, num_envs: int, **options: Any) -> PickAndPlaceEnv:
        """Return worlds without instructions; see :class:`World`."""
        return Grid("move").simulator(num_envs, **options)

    def instructed(self, num_envs: int, **options: Any) -> PickAndPlaceEnv:
        """Return worlds to play in, whose instructions and rewards are those of another task."""
        return Grid("move").instructed(num_envs, **options)
