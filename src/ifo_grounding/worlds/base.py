"""What a recipe needs of a world."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.attributes import attribute
from ifo_grounding.data import Demonstrations, Truth
from ifo_grounding.data.recorded import load_recorded
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import Endings, SuitabilityResult
from ifo_grounding.tasks import Vocabulary


class Oracle(Protocol):
    """What knows the truth of a world: for evaluation alone."""

    def suitable_rate(self, classifier: Any, pool: Tensor, **options: Any) -> SuitabilityResult:
        """Check the instructions that a classifier chooses for fresh states."""

    def endings(self, policy: nn.Module, episodes: int, **scenes: Any) -> Endings:
        """Say how the policy's episodes end."""

    def suits(
        self, instruction: Tensor, scene: int, *, seed: int, stream: str, state: Any = None
    ) -> str:
        """Say whether an instruction suits a scene or a state, ``suitable``, or why not."""


class World(ABC):
    """A world that every recipe runs in.

    A class of one's own gives the simulator and the instructed world; ``demonstrate`` too, if it
    can make demonstrations, which are otherwise recorded elsewhere (``recorded=FOLDER``). It is
    chosen by ``world=own world._target_=package.Class``, its arguments by ``+world.NAME=VALUE``.

    Attributes:
        actions: names of the actions, in their order.
        stop_action: number of the action by which a policy ends an episode; None without any.
        vocabulary: the words of instructions; None until the demonstrations tell them, which
            recipes then set.
        oracle: what knows the truth; None where nobody does.
        rewarded: whether instructed worlds pay success. Without, nothing is evaluated: a person
            looks at what was learned (``ifo-grounding play``).
        tiles: what the numbers that :meth:`coded` shows stand for, uint8 [K, C, T, T], which
            networks then read (:func:`ifo_grounding.networks.read_codes`); None for pixels.
    """

    actions: Sequence[str] = ()
    stop_action: int | None = None
    vocabulary: Vocabulary | None = None
    oracle: Oracle | None = None
    rewarded: bool = True
    tiles: Tensor | None = None

    @abstractmethod
    def simulator(self, num_envs: int, *, seed: int, device: str = "cpu") -> EnvBase:
        """Return all that a learner may step: training scenes without instructions and rewards.

        The environment has the batch size [num_envs] and shows ``pixels``, uint8 [*B, C, H, W].
        """

    def coded(self, num_envs: int, **options: Any) -> EnvBase:
        """Return the simulator in which to practise: as it is, unless pixels can be left out.

        A world that has ``tiles`` shows their numbers in place of pixels.
        """
        return self.simulator(num_envs, **options)

    @abstractmethod
    def instructed(
        self,
        num_envs: int,
        *,
        seed: int,
        stream: str,
        split: str = "all",
        waits: bool = False,
        device: str = "cpu",
    ) -> EnvBase:
        """Return worlds with an instruction, which pay success: for evaluation alone.

        Args:
            split: which instructions, where a world knows several splits.
            waits: whether an episode whose instruction is fulfilled goes on until the policy stops,
                so that a learned reward at the stop can be compared with success.
        """

    def demonstrate(
        self, n: int, *, seed: int, stream: str = "training", progress: bool = False
    ) -> tuple[Demonstrations, Truth | None]:
        """Record demonstrations, and apart from them the truth that only evaluation may read.

        Raises:
            UserError: where the world makes none.
        """
        raise UserError(
            f"{type(self).__name__} makes no demonstrations: give recorded=FOLDER, a folder that "
            "Demonstrations.save or save_pictures wrote"
        )

    def steppable(self, num_envs: int, *, seed: int, device: str = "cpu") -> EnvBase:
        """Return worlds whose scene number i is the first state of demonstration i of a seed.

        For rivals that may step from demonstrations' states, as no learner of ours may.

        Raises:
            UserError: where the world cannot go back to them.
        """
        raise UserError(f"{type(self).__name__} cannot begin where a demonstration began")

    def demonstrator(self, episodes: int, *, seed: int, stream: str) -> Tensor:
        """Return the demonstrator's own success in the scenes of a stream, bool [episodes].

        Raises:
            UserError: where the world has none.
        """
        raise UserError(f"{type(self).__name__} has no demonstrator to compare with")

    def image_shape(self, method: str, **options: Any) -> tuple[int, ...]:
        """Return the shape [C, H, W] of the images that ``simulator`` or ``instructed`` shows.

        Raises:
            UserError: where it takes other arguments, or where of two worlds it returns no
                environment of that batch size, with pixels, and with the stop of this world.
        """
        name = f"{type(self).__name__}.{method}"
        try:
            env = getattr(self, method)(2, **options)
        except TypeError as error:
            given = "".join(f", {option}=" for option in options)
            raise UserError(f"{name}(num_envs{given}) cannot be called: {error}") from None
        pixels = env.observation_spec.get(keys.PIXELS, None) if isinstance(env, EnvBase) else None
        if pixels is None or pixels.dtype != torch.uint8 or pixels.shape[:-3] != (2,):
            shown = "no pixels" if pixels is None else f"pixels {pixels.dtype}{[*pixels.shape]}"
            raise UserError(
                f"{name}(2, ...) returned {type(env).__name__} with {shown}: let it return a "
                "TorchRL environment of batch size [2] whose pixels are uint8 [2, C, H, W]"
            )
        if (stop := attribute(env, "stop_action")) not in (None, self.stop_action):
            raise UserError(
                f"{type(self).__name__}.stop_action is {self.stop_action}, that of {name}(...) "
                f"{stop}: let both name the action by which a policy says that it is done"
            )
        shape = tuple(pixels.shape[1:])
        env.close()
        return shape

    def read(self, folder: str | Path, progress: bool = False) -> Demonstrations:
        """Read demonstrations that were recorded elsewhere.

        Raises:
            UserError: where there are none, or they show other images than the simulator.
        """
        demos = load_recorded(Path(folder), vocabulary=self.vocabulary, progress=progress)
        if not demos.cut.any():
            demos = demos.close_episodes()
        if self.vocabulary is None:
            self.vocabulary = demos.vocabulary
        elif demos.vocabulary != self.vocabulary:
            raise UserError(
                f"instructions in {folder} have another vocabulary than the world: record them "
                "with that of the world"
            )
        shown = self.image_shape("simulator", seed=0)
        if demos.image_shape != shown:
            raise UserError(
                f"frames in {folder} are {list(demos.image_shape)}, those of the simulator "
                f"{list(shown)}: make the world as it was recorded, or read them yourself, scaled "
                "(load_lerobot(size=...)), and save() what you read"
            )
        return demos


class Tiled(World):
    """A world whose simulator shows numbers of tiles in place of pixels, with ``codes=True``."""

    def __init_subclass__(cls) -> None:
        """Let a simulator that a subclass has changed show pixels, which may be other ones."""
        if Tiled not in cls.__bases__ and "simulator" in vars(cls) and "coded" not in vars(cls):
            cls.coded, cls.tiles = World.coded, None  # type: ignore[method-assign,assignment]

    def coded(self, num_envs: int, **options: Any) -> EnvBase:
        """Return the simulator in codes; see :class:`World`."""
        return self.simulator(num_envs, codes=True, **options)  # type: ignore[call-arg]

    @property
    def tiles(self) -> Tensor | None:  # type: ignore[override]
        """What the numbers that :meth:`coded` shows stand for."""
        return getattr(self.coded(1, seed=0), "tiles", None)
