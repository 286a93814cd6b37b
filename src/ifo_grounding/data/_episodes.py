"""Episodes of others, one after the other: readers yield them, and one builder checks them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ifo_grounding.channels import channels_last
from ifo_grounding.data._spool import PIECE_BYTES
from ifo_grounding.errors import UserError, at_least_one, check_below, optional
from ifo_grounding.files import regular_file
from ifo_grounding.tasks.vocabulary import MOST_WORDS, Vocabulary, check_vocabulary, words_of

PIECE_FRAMES = 512
MOST_FRAMES = 100_000
MOST_BYTES = 1 << 30
"""What an episode may hold in a file: small files can claim a lot."""

Name = str | int
Frames = Tensor | np.ndarray
Episode = tuple[Name, Frames, str] | tuple[Name, Frames, str, bool]
"""Name, frames uint8 [T + 1, C, H, W], instruction, and whether the recording was cut."""


class Reader:
    """Checks episodes as ``Demonstrations.from_episodes`` takes them; notes all but the frames."""

    def __init__(
        self,
        *,
        close: bool = False,
        vocabulary: Vocabulary | None = None,
        length: int | None = None,
    ) -> None:
        self.close, self.vocabulary = close, vocabulary
        if vocabulary is not None:
            check_vocabulary(vocabulary)
        given = MOST_WORDS if length is None else at_least_one("length", length)
        self.length = given if vocabulary is None else vocabulary.length
        self.lengths: list[int] = []
        self.sentences: list[str] = []
        self._first: tuple[Name, list[int]] | None = None

    def pieces(self, episodes: Iterable[Episode]) -> Iterator[Tensor]:
        """Yield frames of several episodes together, uint8 [F, C, H, W], or refuse one by name."""
        waiting: list[Tensor] = []
        for number, episode in enumerate(episodes):
            if not isinstance(episode, tuple | list) or len(episode) not in (3, 4):
                raise UserError(
                    f"episode {number} is {_kind(episode)}: give a tuple of three, name, frames "
                    "and instruction"
                )
            name, frames, sentence, *cut = episode
            if not isinstance(name, str | int | np.integer):
                raise UserError(
                    f"episode {number} is named by {_kind(name)}: give name, frames and "
                    "instruction in this order"
                )
            self.sentences.append(self._sentence(name, sentence))
            waiting.append(self._frames(name, frames, self.close and not any(cut)))
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
        kept = self.vocabulary is not None and self.vocabulary.punctuation
        words = len(words_of(sentence, kept)) if isinstance(sentence, str) else 0
        if not words:
            found = repr(sentence) if isinstance(sentence, str | None) else _kind(sentence)
            raise UserError(f"episode {name!r} has no instruction (found {found}): give a sentence")
        if words > self.length:
            raise UserError(
                f"episode {name!r} has an instruction of {words} words, {self.length} are allowed: "
                "shorten it, or give a longer length, or a vocabulary that has one"
            )
        if self.vocabulary is not None:
            with naming(name):
                self.vocabulary.encode(sentence)
        return sentence

    def _frames(self, name: Name, given: Frames, close: bool) -> Tensor:
        if given is None:
            raise UserError(f"episode {name!r} has no frames")
        try:
            given = given if isinstance(given, Tensor) else np.require(given, None, ["C", "W"])
            frames = torch.as_tensor(given).cpu()
        except (TypeError, ValueError, RuntimeError):
            raise UserError(f"episode {name!r}: its frames are not arrays of one size") from None
        if frames.dtype != torch.uint8 or frames.ndim != 4 or not frames.numel():
            raise UserError(
                f"episode {name!r} is {frames.dtype} {list(frames.shape)}: give uint8 "
                "[T + 1, C, H, W] with at least one frame; C is 1 for grey, 3 for colours, 4 with "
                "alpha; of floats in 0..1 np.round(255 * frames).astype(np.uint8)"
            )
        shape = list(frames.shape[1:])
        if channels_last(frames.shape):
            raise UserError(
                f"episode {name!r} has images {shape}, with the colours last: give "
                "[T + 1, C, H, W], such as frames.transpose(0, 3, 1, 2)"
            )
        first, expected = self._first = self._first or (name, shape)
        if shape != expected:
            raise UserError(
                f"episode {name!r} has images {shape}, the others have {expected} (such as episode "
                f"{first!r}): scale them to one size"
            )
        if close and (len(frames) == 1 or not torch.equal(frames[-1], frames[-2])):
            return torch.cat([frames, frames[-1:]])
        return frames.clone()  # whoever gives episodes one by one may write to their array again


def check_size(frames: int, size: int) -> None:
    """Refuse an episode of too many frames, or frames of too many bytes, before it is read."""
    if frames > MOST_FRAMES or size > MOST_BYTES:
        raise UserError(
            f"it has more than {MOST_FRAMES} frames or {MOST_BYTES >> 20} MiB of pixels: cut it "
            "into shorter episodes, or make its images smaller"
        )


def _kind(value: object) -> str:
    sized = f" of {len(value)}" if isinstance(value, tuple | list) else ""
    return f"a {type(value).__name__}{sized}"


def open_table(path: Path, kind: str = "parquet", **options: Any) -> Any:
    """Open a table, or a folder of them; what is no regular file, as a pipe, is an OSError."""
    for file in [path, *path.rglob("*")]:
        if not file.is_dir():
            regular_file(file)
    dataset: Any = optional("pyarrow.dataset", extra="datasets")
    form: Any = kind
    if kind == "parquet":  # pages that have a checksum are compared with it
        checks = dataset.ParquetFragmentScanOptions(page_checksum_verification=True)
        form = dataset.ParquetFileFormat(default_fragment_scan_options=checks)
    return dataset.dataset(path, format=form, **options)


def read_table(table: Any, **chosen: Any) -> Any:
    """Return what is chosen of a table, which is of one episode; refuse too much of it."""
    arrow, read = optional("pyarrow", extra="datasets"), list[Any]()
    try:
        for batch in table.to_batches(batch_size=256, **chosen):
            read.append(batch)
            check_size(sum(part.num_rows for part in read), sum(part.nbytes for part in read))
        found = arrow.Table.from_batches(read)
        found.validate(full=True)  # of text that lies outside of its column an error shows 500 MB
        return found
    except arrow.ArrowException as error:  # some are no errors of Python's own kinds
        raise OSError(error) from None


@contextlib.contextmanager
def naming(name: Name) -> Iterator[None]:
    """Put the name of an episode before what is said of a mistake in it."""
    try:
        yield
    except UserError as error:
        raise UserError(f"episode {name!r}: {error}") from None


def check_parts(frames: int, lengths: Tensor, instructions: Tensor, vocabulary_size: int) -> None:
    """Refuse lengths and instructions that do not fit so many frames, or each other."""
    if lengths.ndim != 1 or lengths.dtype.is_floating_point or (lengths < 1).any():
        raise UserError("lengths must be an integer tensor [N] of frames per episode, at least 1")
    if int(lengths.sum()) != frames:
        raise UserError(f"lengths add up to {int(lengths.sum())} frames, there are {frames}")
    if instructions.ndim != 2 or len(instructions) != len(lengths):
        raise UserError(
            f"instructions are {list(instructions.shape)}: give [N, L] for {len(lengths)} episodes"
        )
    if instructions.dtype.is_floating_point:
        raise UserError(f"instructions must be integer token ids, got {instructions.dtype}")
    check_below("instructions hold token", instructions, vocabulary_size)


def padded(instructions: Tensor, vocabulary: Vocabulary) -> Tensor:
    """Return instructions as long as those that a vocabulary makes."""
    missing = vocabulary.length - instructions.shape[-1] if instructions.ndim == 2 else 0
    if missing < 0:
        raise UserError(
            f"instructions have {instructions.shape[-1]} tokens, those of the vocabulary "
            f"{vocabulary.length}: make it with length={instructions.shape[-1]}"
        )
    return F.pad(instructions, (0, missing))


def rows_of(starts: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return number and frame of episodes, int64 [sum of counts] each: so many frames of each."""
    episode = torch.arange(len(starts)).repeat_interleave(counts)
    step = torch.arange(len(episode)) - (counts.cumsum(0) - counts)[episode]
    return episode, starts[episode] + step
