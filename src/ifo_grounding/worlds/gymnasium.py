"""Any instructed world of Gymnasium; demonstrations come from elsewhere."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium

from ifo_grounding.envs import GymnasiumEnv, from_gymnasium
from ifo_grounding.envs.reading import numbered_actions
from ifo_grounding.errors import UserError
from ifo_grounding.worlds.base import World


@dataclass
class Gymnasium(World):
    """A world of Gymnasium with images, sentences and discrete actions.

    Its instruction is in the observation or in ``info``; words of it that no demonstration says are
    left out, with a warning. An episode has succeeded if its last step pays a reward above 0. The
    arguments are those of :func:`~ifo_grounding.envs.from_gymnasium`.
    """

    id: str | None = None
    """Id for ``gymnasium.make``."""
    factory: str | None = None
    """In place of an id: ``package.function`` or ``package.Class`` that makes the world."""
    make: dict[str, Any] = field(default_factory=dict)
    """Arguments of ``gymnasium.make`` or of the factory."""
    image: str | None = "image"
    """Name of the image in the observation; null where the observation is the image."""
    instruction: str = "mission"
    """Name of the sentence in the observation, or else in ``info``."""
    stop: int | str | None = None
    """Number of the action by which a policy says that it is done, ``add`` for one more action that
    never reaches the world, or null without any."""
    names: list[str] | None = None
    """Names of the actions; numbers by default."""

    def __post_init__(self) -> None:
        if (self.id is None) == (self.factory is None):
            raise UserError("name the world by one of world.id=... and world.factory=...")
        world = self._maker()()
        count, self.stop_action = numbered_actions(world.action_space, self.stop)
        world.close()
        self.actions = self.names or [*map(str, range(count))]

    def simulator(self, num_envs: int, **options: Any) -> GymnasiumEnv:
        """Return worlds without instructions and rewards; see :class:`World`."""
        return self._worlds(num_envs, instructed=False, **options)

    def instructed(
        self, num_envs: int, *, split: str = "all", waits: bool = False, **options: Any
    ) -> GymnasiumEnv:
        """Return worlds with their instructions, which end as they end."""
        return self._worlds(num_envs, instructed=True, **options)

    def _maker(self) -> Callable[[], gymnasium.Env]:
        if self.factory is None:
            return lambda: gymnasium.make(str(self.id), **self.make)
        try:
            factory = pkgutil.resolve_name(self.factory)
        except Exception as error:  # whatever the module raises as it is imported
            raise UserError(
                f"world.factory={self.factory} cannot be imported: {error}; is the folder of its "
                "module in PYTHONPATH?"
            ) from None
        if not callable(factory):
            raise UserError(f"world.factory={self.factory} is no function or class")
        return lambda: factory(**self.make)

    def _worlds(self, num_envs: int, **options: Any) -> GymnasiumEnv:
        if self.vocabulary is None:
            raise UserError("read demonstrations first: they hold the words of instructions")
        return from_gymnasium(
            self._maker(),
            vocabulary=self.vocabulary,
            num_envs=num_envs,
            image=self.image,
            instruction=self.instruction,
            stop=self.stop,
            skip_unknown=True,  # no demonstration taught them
            **options,
        )
