"""One world of Gymnasium, read as arrays of fixed sizes."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from ifo_grounding import keys
from ifo_grounding.errors import UserError, check_choice, whole
from ifo_grounding.tasks.vocabulary import Vocabulary

ENDED = "ended"
"""Whether a world has terminated, whether it was truncated, and whether the policy stopped."""
ADD = "add"
CHANNELS = (1, 3, 4)


class Reading:
    """Reads image and instruction out of what a world shows; arguments are `from_gymnasium`'s."""

    def __init__(
        self,
        vocabulary: Vocabulary,
        image: str | None,
        instruction: str,
        instructed: bool,
        stop: int | str | None = None,
        skip_unknown: bool = False,
    ) -> None:
        if isinstance(stop, str):
            check_choice("stop", stop, (ADD,))
        elif stop is not None:
            stop = whole("stop", stop)
        if not isinstance(vocabulary, Vocabulary):
            raise UserError(
                "vocabulary is a Vocabulary, such as that of the demonstrations or "
                f"Vocabulary.from_sentences(...), got {type(vocabulary).__name__}"
            )
        self.vocabulary, self.image = vocabulary, image
        self.instruction, self.instructed, self.stop = instruction, instructed, stop
        self.skip_unknown = skip_unknown

    def pixels(self, observation: Any) -> np.ndarray:
        """Return the image, uint8 [C, H, W]."""
        seen = observation
        if self.image is not None:
            if not isinstance(observation, dict) or self.image not in observation:
                shown = sorted(observation) if isinstance(observation, dict) else "one array"
                raise UserError(
                    f"there is no image {self.image!r} in the observation ({shown}): name it with "
                    "image=..., or image=None where the observation is the image"
                )
            seen = observation[self.image]
        picture = np.asarray(seen)
        if picture.dtype != np.uint8 or picture.ndim not in (2, 3):
            raise UserError(
                f"images are bytes [H, W, C], [C, H, W] or [H, W], got {picture.dtype} "
                f"{list(picture.shape)}: wrap the world so that it shows pixels"
            )
        if picture.ndim == 2:
            return picture[None]
        if picture.shape[-1] in CHANNELS and picture.shape[0] not in CHANNELS:
            return np.ascontiguousarray(picture.transpose(2, 0, 1))
        if picture.shape[0] in CHANNELS:
            return np.ascontiguousarray(picture)
        raise UserError(f"an image has 1, 3 or 4 channels, got an array of {list(picture.shape)}")

    def sentence(self, observation: Any, info: dict[str, Any]) -> str:
        """Return the instruction."""
        for source in (observation, info):
            if isinstance(source, dict) and self.instruction in source:
                return str(source[self.instruction])
        shown = sorted(observation) if isinstance(observation, dict) else "one array"
        raise UserError(
            f"there is no instruction {self.instruction!r} in the observation ({shown}) or in info "
            f"({sorted(info)}): name it with instruction=..."
        )


class Read(gymnasium.Wrapper):
    """One world as :class:`Reading` reads it: arrays of fixed sizes, which can be batched.

    A vector of worlds refuses to step those that have ended, while tensordicts are stepped as a
    whole. So ends are told beside the image, and a world that has ended stays as it is.
    """

    def __init__(self, env: gymnasium.Env, reading: Reading) -> None:
        if not isinstance(env, gymnasium.Env):
            raise UserError(f"a world is a gymnasium.Env, got {type(env).__name__}")
        super().__init__(env)
        if not isinstance(env.action_space, gymnasium.spaces.Discrete) or env.action_space.start:
            raise UserError(
                f"actions must be Discrete from 0, got {env.action_space}: wrap the world so that "
                "they are"
            )
        self.reading = reading
        count = int(env.action_space.n)
        added = reading.stop == ADD
        if not (added or reading.stop is None or reading.stop in range(count)):
            raise UserError(
                f"stop must be an action 0..{count - 1} or {ADD!r}, got {reading.stop!r}"
            )
        self.stop = count if added else reading.stop
        self.action_space = gymnasium.spaces.Discrete(count + added)
        self._added = count if added else None
        self._last: dict[str, np.ndarray] | None = None
        observation, info = env.reset(seed=0)
        pixels = reading.pixels(observation)
        self._shape = pixels.shape
        spaces: dict[str, gymnasium.Space] = {
            keys.PIXELS: gymnasium.spaces.Box(0, 255, pixels.shape, np.uint8),
            ENDED: gymnasium.spaces.MultiBinary(3),
        }
        if reading.instructed:
            words = reading.vocabulary
            spaces[keys.INSTRUCTION] = gymnasium.spaces.Box(
                0, len(words) - 1, (words.length,), np.int64
            )
            self._tokens = self._encode(observation, info)
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(self, **options: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(**options)
        if self.reading.instructed:
            self._tokens = self._encode(observation, info)
        self._last = self._seen(observation, False, False, False)
        return self._last, {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take an action; the instruction is the one read at the reset."""
        if self._last is None:
            raise UserError("there is no episode yet: reset the environment first")
        if self._last[ENDED].any():
            return self._last, 0.0, False, False, {}
        stopped = int(action) == self.stop
        if int(action) == self._added:
            self._last = {**self._last, ENDED: np.array([0, 0, 1], dtype=np.int8)}
            return self._last, 0.0, False, False, {}
        observation, reward, terminated, truncated, _ = self.env.step(int(action))
        self._last = self._seen(observation, terminated, truncated, stopped)
        return self._last, float(reward), False, False, {}

    def _encode(self, observation: Any, info: dict[str, Any]) -> np.ndarray:
        sentence = self.reading.sentence(observation, info)
        skip = self.reading.skip_unknown
        return self.reading.vocabulary.encode(sentence, skip_unknown=skip)[0].numpy()

    def _seen(self, observation: Any, *ended: bool) -> dict[str, np.ndarray]:
        pixels = self.reading.pixels(observation)
        if pixels.shape != self._shape:
            raise UserError(
                f"the image was {list(self._shape)} and is now {list(pixels.shape)}: wrap the "
                "world so that its size stays"
            )
        seen = {keys.PIXELS: pixels, ENDED: np.array(ended, dtype=np.int8)}
        return {**seen, keys.INSTRUCTION: self._tokens} if self.reading.instructed else seen
