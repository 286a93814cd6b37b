"""One world of Gymnasium, read as arrays of fixed sizes."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from ifo_grounding import keys
from ifo_grounding.errors import UserError
from ifo_grounding.tasks.vocabulary import Vocabulary

ENDED = "ended"
"""Whether a world has terminated, whether it was truncated, and whether the policy stopped."""
ADD = "add"
CHANNELS = (1, 3, 4)


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
        if not isinstance(env.action_space, gymnasium.spaces.Discrete) or env.action_space.start:
            raise UserError(
                f"actions must be Discrete from 0, got {env.action_space}: wrap the world so that "
                "they are"
            )
        self.vocabulary, self.skip_unknown = vocabulary, skip_unknown
        self.image, self.instruction, self.instructed = image, instruction, instructed
        count = int(env.action_space.n)
        self._added = count if stop == ADD else None
        self.stop = count if stop == ADD else stop
        self.action_space = gymnasium.spaces.Discrete(count + (stop == ADD))
        if self.stop is not None and self.stop not in range(self.action_space.n):
            raise UserError(f"stop must be an action 0..{count - 1} or {ADD!r}, got {stop!r}")
        self._last: dict[str, np.ndarray] | None = None
        observation, info = env.reset(seed=0)
        self._shape = self._pixels(observation).shape
        spaces: dict[str, gymnasium.Space] = {
            keys.PIXELS: gymnasium.spaces.Box(0, 255, self._shape, np.uint8),
            ENDED: gymnasium.spaces.MultiBinary(3),
        }
        if instructed:
            self._tokens = self._encode(observation, info)
            words = gymnasium.spaces.Box(0, len(vocabulary) - 1, self._tokens.shape, np.int64)
            spaces[keys.INSTRUCTION] = words
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(self, **options: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(**options)
        if self.instructed:
            self._tokens = self._encode(observation, info)
        self._last = self._seen(observation, False, False, False)
        return self._last, {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take an action; the instruction is the one read at the reset."""
        if self._last is None:
            raise UserError("there is no episode yet: reset the environment first")
        if self._last[ENDED].any():
            return self._last, 0.0, False, False, {}
        if int(action) == self._added:
            self._last = {**self._last, ENDED: np.array([0, 0, 1], dtype=np.int8)}
            return self._last, 0.0, False, False, {}
        observation, reward, terminated, truncated, _ = self.env.step(int(action))
        self._last = self._seen(observation, terminated, truncated, int(action) == self.stop)
        return self._last, float(reward), False, False, {}

    def _seen(self, observation: Any, *ended: bool) -> dict[str, np.ndarray]:
        pixels = self._pixels(observation)
        if pixels.shape != self._shape:
            raise UserError(
                f"the image was {list(self._shape)} and is now {list(pixels.shape)}: wrap the "
                "world so that its size stays"
            )
        seen = {keys.PIXELS: pixels, ENDED: np.array(ended, dtype=np.int8)}
        return {**seen, keys.INSTRUCTION: self._tokens} if self.instructed else seen

    def _pixels(self, observation: Any) -> np.ndarray:
        """Return the image, uint8 [C, H, W]."""
        if self.image is not None and self.image not in _names(observation):
            raise UserError(
                f"there is no image {self.image!r} in the observation ({_names(observation)}): "
                "name it with image=..., or image=None where the observation is the image"
            )
        picture = np.asarray(observation if self.image is None else observation[self.image])
        if picture.dtype != np.uint8 or picture.ndim not in (2, 3):
            raise UserError(
                f"images are bytes [H, W, C], [C, H, W] or [H, W], got {picture.dtype} "
                f"{list(picture.shape)}: wrap the world so that it shows pixels"
            )
        if picture.ndim == 2:
            return picture[None]
        if picture.shape[0] in CHANNELS:
            return np.ascontiguousarray(picture)
        if picture.shape[-1] in CHANNELS:
            return np.ascontiguousarray(picture.transpose(2, 0, 1))
        raise UserError(f"an image has 1, 3 or 4 channels, got an array of {list(picture.shape)}")

    def _encode(self, observation: Any, info: dict[str, Any]) -> np.ndarray:
        """Return the tokens of the instruction, int64 [L]."""
        found = [part for part in (observation, info) if self.instruction in _names(part)]
        if not found:
            raise UserError(
                f"there is no instruction {self.instruction!r} in the observation "
                f"({_names(observation)}) or in info ({_names(info)}): name it with instruction=..."
            )
        sentence = str(found[0][self.instruction])
        return self.vocabulary.encode(sentence, skip_unknown=self.skip_unknown)[0].numpy()


def _names(source: Any) -> list[str]:
    """Return the names of what is observed, none of a single array."""
    return sorted(source) if isinstance(source, dict) else []
