"""One world of Gymnasium, read as arrays of fixed sizes."""

from __future__ import annotations

import contextlib
import inspect
import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from ifo_grounding import keys
from ifo_grounding.channels import channels_first
from ifo_grounding.errors import UserError, whole
from ifo_grounding.mosaic import check_tiles
from ifo_grounding.tasks.vocabulary import Vocabulary

ENDED = "ended"
"""Whether a world has terminated, whether it was truncated, and whether the policy stopped."""
ADD = "add"
CODES = np.int16
"""Type of the numbers of tiles."""


def numbered_actions(space: gymnasium.Space, stop: int | str | None) -> tuple[int, int | None]:
    """Return how many actions there are, and the number of the stop, or refuse them."""
    if not isinstance(space, spaces.Discrete):
        raise UserError(f"actions must be Discrete, got {space}: wrap it by {_wrapper_of(space)}")
    count = int(space.n)
    if stop in (None, ADD):
        return count + (stop == ADD), count if stop == ADD else None
    if isinstance(stop, str) or whole("stop", stop) not in range(count):
        raise UserError(f"stop must be an action 0..{count - 1} or {ADD!r}, got {stop!r}")
    return count, int(stop)


def _wrapper_of(space: gymnasium.Space) -> str:
    """Return the line that makes actions of another space ``Discrete``."""
    said = ", with a list CHOICES of actions: continuous ones are not supported"
    chosen, count = "CHOICES[a]", "len(CHOICES)"
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        sizes = tuple(getattr(space, "nvec", np.full(space.shape, 2)).ravel().tolist())
        chosen, count, said = f"np.array(np.unravel_index(a, {sizes}))", str(math.prod(sizes)), ""
    return f"gymnasium.wrappers.TransformAction(world, lambda a: {chosen}, Discrete({count})){said}"


class Reading(gymnasium.Wrapper):
    """One world whose image and instruction are arrays of fixed sizes, which can be batched.

    A vector of worlds refuses to step those that have ended, while tensordicts are stepped as a
    whole. So ends are told beside the image, and a world that has ended stays as it is. Arguments
    are those of :func:`~ifo_grounding.envs.from_gymnasium`.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        vocabulary: Vocabulary,
        image: str | None,
        instruction: str,
        instructed: bool,
        stop: int | str | None,
        skip_unknown: bool,
    ) -> None:
        if not isinstance(env, gymnasium.Env):
            raise UserError(f"a world is a gymnasium.Env, got {type(env).__name__}")
        super().__init__(env)
        self._name = type(env.unwrapped).__name__
        count, self.stop = numbered_actions(env.action_space, stop)
        own: Any = env.action_space
        self._count, self._start = int(own.n), int(own.start)
        self.action_space = spaces.Discrete(count)
        taken = inspect.signature(env.unwrapped.reset).parameters.values()
        if not any(each.name == "seed" or each.kind is each.VAR_KEYWORD for each in taken):
            raise UserError(f"{self._name}.reset takes no seed: add seed=None, options=None")
        self.vocabulary, self.skip_unknown = vocabulary, skip_unknown
        self.image, self.instruction, self.instructed = image, instruction, instructed
        self.tiles: Any = None
        if env.has_wrapper_attr("tiles"):
            self.tiles = env.get_wrapper_attr("tiles")
        self._last: dict[str, np.ndarray] | None = None
        first = self._pixels(self._begin(seed=0))
        self._shape = first.shape
        values = 256
        if first.dtype == CODES:
            check_tiles(self.tiles)
            values = len(self.tiles)
        parts: dict[str, gymnasium.Space] = {
            keys.PIXELS: spaces.Box(0, values - 1, first.shape, first.dtype.type),
            ENDED: spaces.MultiBinary(3),
        }
        if instructed:
            high, shape = len(vocabulary) - 1, self._tokens.shape
            parts[keys.INSTRUCTION] = spaces.Box(0, high, shape, np.int64)
        self.observation_space = spaces.Dict(parts)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        self._last = self._seen(self._begin(seed), False, False, False)
        return self._last, {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take an action; the instruction is the one read at the reset."""
        if self._last is None:
            raise UserError("there is no episode yet: reset the environment first")
        if self._last[ENDED].any():
            return self._last, 0.0, False, False, {}
        if int(action) == self._count:  # the one that is added
            self._last = {**self._last, ENDED: np.array([0, 0, 1], dtype=np.int8)}
            return self._last, 0.0, False, False, {}
        try:
            found: Any = self.env.step(self._start + int(action))
        except ValueError as error:
            if "expected 5, got 4" not in str(error):
                raise
            found = (None,) * 4  # of an old world that TimeLimit or the like took apart
        observation, reward, terminated, truncated, info = self._parts(
            "step", found, "observation, reward, terminated, truncated, info"
        )
        if self.instructed and self._said(observation, info) not in (None, self._sentence):
            raise UserError(
                f"the instruction of {self._name} changed in an episode, from {self._sentence!r} "
                f"to {self._said(observation, info)!r}: an episode follows one, end it there"
            )
        self._last = self._seen(observation, terminated, truncated, int(action) == self.stop)
        return self._last, self._paid(reward), False, False, {}

    def _begin(self, seed: int | None) -> Any:
        """Reset the world, note its instruction, and return the observation."""
        observation, info = self._parts("reset", self.env.reset(seed=seed), "observation, info")
        if not self.instructed:
            return observation
        self._sentence = said = self._said(observation, info)
        if said is None:
            raise UserError(
                f"there is no instruction {self.instruction!r} in the observation "
                f"({_names(observation)}) or in info ({_names(info)}): name it with instruction=..."
            )
        self._tokens = self.vocabulary.encode(said, skip_unknown=self.skip_unknown)[0].numpy()
        return observation

    def _parts(self, method: str, found: Any, names: str) -> Any:
        """Return what a method of the world returned, if it is as Gymnasium has it."""
        got = f"{len(found)} values" if isinstance(found, tuple) else type(found).__name__
        if got != f"{len(names.split())} values":
            raise UserError(
                f"{self._name}.{method} must return {names}, got {got}: wrap old worlds"
            )
        return found

    def _paid(self, reward: Any) -> float:
        with contextlib.suppress(TypeError, ValueError):
            if math.isfinite(paid := float(np.asarray(reward).item())):
                return paid
        raise UserError(f"{self._name} pays {reward!r:.40}: a reward is one finite number")

    def _seen(self, observation: Any, *ended: Any) -> dict[str, np.ndarray]:
        pixels = self._pixels(observation)
        if pixels.shape != self._shape:
            raise UserError(
                f"the image was {list(self._shape)} and is now {list(pixels.shape)}: wrap the "
                "world so that its size stays"
            )
        seen = {keys.PIXELS: pixels, ENDED: np.array([*map(bool, ended)], dtype=np.int8)}
        return {**seen, keys.INSTRUCTION: self._tokens} if self.instructed else seen

    def _pixels(self, observation: Any) -> np.ndarray:
        """Return the image, uint8 [C, H, W]; stacked frames [K, H, W, C] have K * C channels.

        Numbers of the world's tiles, int16 [h, w], stay as they are.
        """
        if self.image is not None and self.image not in _names(observation):
            raise UserError(
                f"there is no image {self.image!r} in the observation ({_names(observation)}): "
                "name it with image=..., or image=None where the observation is the image"
            )
        picture = np.asarray(observation if self.image is None else observation[self.image])
        if self.tiles is not None and picture.dtype == CODES and picture.ndim == 2:
            return picture
        if picture.dtype != np.uint8 or picture.ndim not in (2, 3, 4):
            raise UserError(
                f"images are bytes [H, W, C], [C, H, W] or [H, W], or a stack of them, got "
                f"{picture.dtype} {list(picture.shape)}: wrap the world so that it shows pixels"
            )
        return channels_first(picture[None])[0]

    def _said(self, observation: Any, info: Any) -> str | None:
        """Return the instruction that is said, of stacked observations the last one's."""
        found = [part for part in (observation, info) if self.instruction in _names(part)]
        said: Any = found[0][self.instruction] if found else None
        said = said[-1] if isinstance(said, tuple) and said else said
        if found and not isinstance(said, str | bytes):
            raise UserError(f"an instruction is text, got {type(said).__name__} {said!r:.40}")
        return said.decode() if isinstance(said, bytes) else said


def _names(source: Any) -> list[str]:
    """Return the names of what is observed, none of a single array."""
    return sorted(source) if isinstance(source, dict) else []
