"""Episodes of others, one after the other: readers yield them, and one builder checks them."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterable, Iterator

import numpy as np
import torch
from PIL import ExifTags, Image, ImageOps
from torch import Tensor

from ifo_grounding.errors import UserError
from ifo_grounding.tasks.vocabulary import Vocabulary

PIECE_FRAMES = 512
PIECE_BYTES = 16 << 20
COLOURS = (1, 3)
MODES = {1: "L", 3: "RGB", 4: "RGBA"}
"""Modes of Pillow by channels."""
LAST = tuple(MODES)
LEAST_SIDE = 5
"""Arrays whose last axis alone is shorter than this are taken for images with colours last."""
ORIENTATION = ExifTags.Base.Orientation
NOT_BYTES = ("F", "I", "I;16", "I;16L", "I;16B", "I;16N")
"""Modes of Pillow whose values are not bytes: turned into bytes, most become black or white."""

BROKEN = (
    *(OSError, SyntaxError, ValueError, IndexError, EOFError),
    *(struct.error, Image.DecompressionBombError),
)
"""What Pillow raises for files that are damaged or cut short."""

Name = str | int
Episode = tuple[Name, Tensor | np.ndarray, str]
"""Name, frames uint8 [T + 1, C, H, W], and instruction."""


class Reader:
    """Checks episodes one after the other, and notes all of them but the frames.

    Args:
        close: whether to repeat the last frame of episodes that do not end with a repeated frame.
        vocabulary: the words that instructions may use; any by default.
        length: words that an instruction may have, without a vocabulary; any number by default.
    """

    def __init__(
        self,
        *,
        close: bool = False,
        vocabulary: Vocabulary | None = None,
        length: int | None = None,
    ) -> None:
        self.close, self.vocabulary = close, vocabulary
        self.length = length if vocabulary is None else vocabulary.length
        self.lengths: list[int] = []
        self.sentences: list[str] = []
        self._first: tuple[Name, list[int]] | None = None

    def pieces(self, episodes: Iterable[Episode]) -> Iterator[Tensor]:
        """Yield frames of several episodes together, uint8 [F, C, H, W].

        Raises:
            UserError: naming the first episode that is not as it has to be.
        """
        waiting: list[Tensor] = []
        for number, episode in enumerate(episodes):
            if not isinstance(episode, tuple | list) or len(episode) != 3:
                raise UserError(
                    f"episode {number} is {_kind(episode)}: give a tuple of three, name, frames "
                    "and instruction"
                )
            name, frames, sentence = episode
            self.sentences.append(self._sentence(name, sentence))
            waiting.append(self._frames(name, frames))
            self.lengths.append(len(waiting[-1]))
            held = sum(part.nbytes for part in waiting)
            if held >= PIECE_BYTES or sum(map(len, waiting)) >= PIECE_FRAMES:
                yield torch.cat(waiting)
                waiting = []
        if not self.lengths:
            raise UserError("there is no episode")
        if waiting:
            yield torch.cat(waiting)

    def _sentence(self, name: Name, sentence: str) -> str:
        if not isinstance(sentence, str) or not sentence.strip():
            found = repr(sentence) if isinstance(sentence, str | None) else _kind(sentence)
            raise UserError(f"episode {name!r} has no instruction (found {found}): give a sentence")
        words = len(sentence.split())
        if self.length and words > self.length:
            longer = "length=" if self.vocabulary is None else "a vocabulary with length="
            raise UserError(
                f"episode {name!r} has an instruction of {words} words, {self.length} are allowed: "
                f"give {longer}{words}"
            )
        if self.vocabulary is not None:
            with naming(name):
                self.vocabulary.encode(sentence)
        return sentence

    def _frames(self, name: Name, given: Tensor | np.ndarray) -> Tensor:
        frames = check_frames(name, given)
        shape = list(frames.shape[1:])
        first, expected = self._first = self._first or (name, shape)
        if shape != expected:
            raise UserError(
                f"episode {name!r} has images {shape}, the others have {expected} (such as episode "
                f"{first!r}): scale them to one size"
            )
        if len(frames) < 2:
            raise UserError(
                f"episode {name!r} has {len(frames)} frame: a demonstration shows at least one "
                "step, which takes two"
            )
        if self.close and (len(frames) == 1 or not torch.equal(frames[-1], frames[-2])):
            return torch.cat([frames, frames[-1:]])
        return frames.clone()  # whoever gives episodes one by one may write to their array again


def _kind(value: object) -> str:
    sized = f" of {len(value)}" if isinstance(value, tuple | list) else ""
    return f"a {type(value).__name__}{sized}"


def check_frames(name: Name, given: Tensor | np.ndarray) -> Tensor:
    """Return frames of an episode as a tensor.

    Raises:
        UserError: naming the episode, where they are not uint8 [T + 1, C, H, W], as far as that can
            be seen: colours last are refused.
    """
    if given is None:
        raise UserError(f"episode {name!r} has no frames")
    try:
        frames = (
            given.cpu()
            if isinstance(given, Tensor)
            else torch.as_tensor(np.require(given, None, ["C", "W"]))
        )
    except (TypeError, ValueError, RuntimeError):
        raise UserError(f"episode {name!r}: its frames are not arrays of one size") from None
    shape = list(frames.shape)
    if not frames.numel():
        wrong = f"is {frames.dtype} {shape}: give uint8 [T + 1, C, H, W] with at least one frame"
    elif frames.is_floating_point():
        scaled = "255 * frames" if frames.max() <= 1 else "frames"
        wrong = (
            f"is {frames.dtype} {shape} of {frames.min():g} to {frames.max():g}: give uint8 "
            f"[T + 1, C, H, W], such as np.round({scaled}).astype(np.uint8)"
        )
    elif frames.dtype != torch.uint8 or frames.ndim != 4:
        wrong = (
            f"is {frames.dtype} {shape}: give uint8 [T + 1, C, H, W] with at least one frame; C is "
            "1 for grey, 3 for colours, 4 with alpha"
        )
    elif shape[-1] < LEAST_SIDE <= min(shape[1:3]):
        wrong = (
            f"has images {shape[1:]}, with the colours last: give [T + 1, C, H, W], such as "
            "frames.transpose(0, 3, 1, 2)"
        )
    else:
        return frames
    raise UserError(f"episode {name!r} {wrong}")


def stack_pictures(
    name: Name, pictures: Iterable[tuple[str, Image.Image]], channels: int = 3
) -> np.ndarray:
    """Return the pictures of an episode, each with its own name, as frames [T + 1, C, H, W].

    C is the number of ``channels``: 1 for grey, 3 for colours, 4 with alpha.

    Raises:
        UserError: naming the episode and the picture, where there is none, or one is of another
            size or not made of bytes.
    """
    frames: list[np.ndarray] = []
    for place, picture in pictures:
        if picture.mode in NOT_BYTES:
            raise UserError(
                f"episode {name!r}: {place} has numbers of mode {picture.mode!r}: save it with 8 "
                "bits per colour"
            )
        try:
            if picture.getexif().get(ORIENTATION, 1) != 1:
                picture = ImageOps.exif_transpose(picture)  # as it is shown
            shown = np.asarray(picture.convert(MODES[channels]))
        except BROKEN as error:
            raise UserError(f"episode {name!r}: {place} cannot be read ({error})") from None
        frames.append(shown.reshape(*shown.shape[:2], channels))
        if frames[-1].shape != frames[0].shape:
            raise UserError(
                f"episode {name!r}: {place} has {_size(frames[-1])} pixels, the first frame has "
                f"{_size(frames[0])}: scale them to one size"
            )
    if not frames:
        raise UserError(f"episode {name!r} has no frames")
    return np.stack(frames).transpose(0, 3, 1, 2)


def _size(frame: np.ndarray) -> str:
    return f"{frame.shape[1]}x{frame.shape[0]}"


@contextlib.contextmanager
def naming(name: Name) -> Iterator[None]:
    """Put the name of an episode before what is said of a mistake in it."""
    try:
        yield
    except UserError as error:
        raise UserError(f"episode {name!r}: {error}") from None
