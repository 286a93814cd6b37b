"""Demonstrations that show frames and say instructions, and nothing else."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.data._episodes import check_parts, distinct_rows, refuse_empty, row_numbers
from ifo_grounding.data._reading import Episode, Reader
from ifo_grounding.data._spool import same_rows, take
from ifo_grounding.data.codec import FrameCodec
from ifo_grounding.data.folder import DAMAGED, fact, load_folder, save_folder
from ifo_grounding.errors import UserError, whole
from ifo_grounding.seeding import generator as seeded
from ifo_grounding.tasks.vocabulary import Vocabulary

KIND = "ifo-grounding demonstrations"
VERSION = 1
MASK = "mask"


class Demonstrations:
    """Observation-only demonstrations: frames of episodes in a row, and an instruction for each.

    T actions leave T + 1 frames; the stop repeats the last frame (see :meth:`close_episodes`).
    There is no place for actions. Frames are stored by a :class:`FrameCodec` and decoded when read;
    a slice or a selection shares the frames of the whole.

    Args:
        codec: turns ``codes`` into pixels.
        codes: codes of all frames in a row, [F, *codec.code_shape].
        lengths: frames of each episode, at least 1, integer [N]; they add up to F.
        instructions: token ids, integer [N, L], 0 pads.
        vocabulary: the words of the tokens; shorter instructions are padded to its length.
        vocabulary_size: number of token ids, padding included; needed only without vocabulary.

    Raises:
        UserError: where the parts do not fit each other.

    >>> frames = [torch.zeros(3, 3, 48, 48, dtype=torch.uint8) for _ in range(5)]
    >>> demos = Demonstrations.from_arrays(frames, ["go up"] * 5)
    >>> len(demos), demos.transitions, demos[0]["pixels"].shape
    (5, 10, torch.Size([3, 3, 48, 48]))
    >>> sorted(demos.sample_transitions(4).keys(True, True), key=str)
    [('next', 'pixels'), 'instruction', 'pixels']
    """

    __slots__ = (
        "_lengths",
        "_starts",
        "_transition_ends",
        "codec",
        "codes",
        "tokens",
        "vocabulary",
        "vocabulary_size",
    )

    def __init__(
        self,
        codec: FrameCodec,
        codes: Tensor,
        lengths: Tensor,
        instructions: Tensor,
        *,
        vocabulary: Vocabulary | None = None,
        vocabulary_size: int | None = None,
    ) -> None:
        if vocabulary is not None:
            vocabulary_size = len(vocabulary)
            instructions = _padded(instructions, vocabulary)
        elif vocabulary_size is None:
            vocabulary_size = int(instructions.max()) + 1 if instructions.numel() else 1
        vocabulary_size = whole("vocabulary_size", vocabulary_size)
        check_parts(codec, codes, lengths, instructions, vocabulary_size)
        self.codec, self.codes = codec, codes
        self.vocabulary, self.vocabulary_size = vocabulary, vocabulary_size
        lengths = lengths.long()
        small = torch.int16 if vocabulary_size <= torch.iinfo(torch.int16).max else torch.int32
        self._set_episodes(lengths.cumsum(0) - lengths, lengths, instructions.to(small))

    def _set_episodes(self, starts: Tensor, lengths: Tensor, tokens: Tensor) -> None:
        self._starts, self._lengths, self.tokens = starts, lengths, tokens
        self._transition_ends = (lengths - 1).cumsum(0)

    @classmethod
    def from_arrays(
        cls,
        frames: Iterable[Tensor | np.ndarray],
        instructions: Tensor | Sequence[str],
        *,
        vocabulary: Vocabulary | None = None,
        length: int | None = None,
        tile_size: int | None = None,
    ) -> Demonstrations:
        """Take frames from elsewhere, as they are: :meth:`close_episodes` adds stops.

        Args:
            frames: one uint8 array [T + 1, C, H, W] per episode, at least two frames; a generator
                is read in pieces.
            instructions: token ids, integer [N, L], or sentences.
            vocabulary: the words of the sentences or tokens; by default that of the sentences.
            length: words that the longest sentence may have, without a vocabulary; by default
                those of the longest that occurs.
            tile_size: of the codec; the cheapest one by default.

        Raises:
            UserError: with the number of the episode that is not as it has to be.
        """
        if not isinstance(instructions, Tensor):
            named: Iterable[Any] = (
                (number, *both) for number, both in enumerate(zip_longest(frames, instructions))
            )
            return cls.from_episodes(
                named, vocabulary=vocabulary, length=length, tile_size=tile_size, close=False
            )
        reader = Reader()
        episodes = ((number, shown, "as said") for number, shown in enumerate(frames))
        codec, codes = FrameCodec.compress(reader.pieces(episodes), tile_size)
        return cls(codec, codes, torch.tensor(reader.lengths), instructions, vocabulary=vocabulary)

    @classmethod
    def from_episodes(
        cls,
        episodes: Iterable[Episode],
        *,
        vocabulary: Vocabulary | None = None,
        length: int | None = None,
        tile_size: int | None = None,
        close: bool = True,
    ) -> Demonstrations:
        """Take episodes one after the other: pixels of a few are in memory at a time.

        Args:
            episodes: name, frames and instruction of each; frames are uint8 [T + 1, C, H, W], at
                least two. A generator is read once.
            vocabulary: the words of the instructions; by default those that occur.
            length: words that the longest instruction may have, without a vocabulary; by default
                those of the longest that occurs.
            tile_size: of the codec; the cheapest one by default.
            close: whether to repeat the last frame of episodes that do not show their stop.

        Raises:
            UserError: naming the episode that is not as it has to be.

        >>> shown = torch.arange(2, dtype=torch.uint8).view(2, 1, 1, 1).expand(2, 3, 48, 48)
        >>> Demonstrations.from_episodes(("a", shown, "go on") for _ in range(2)).lengths
        tensor([3, 3])
        """
        reader = Reader(close=close, vocabulary=vocabulary, length=length)
        codec, codes = FrameCodec.compress(reader.pieces(episodes), tile_size)
        sentences = reader.sentences
        words = vocabulary or Vocabulary.from_sentences(
            sentences, length or max(len(sentence.split()) for sentence in sentences)
        )
        tokens = words.encode(sentences)
        return cls(codec, codes, torch.tensor(reader.lengths), tokens, vocabulary=words)

    # ---- What there is ----------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self._lengths)

    def __repr__(self) -> str:
        return f"Demonstrations({len(self)} episodes, {self.n_frames} frames, {self.codec})"

    @property
    def n_frames(self) -> int:
        """Frames of all episodes."""
        return int(self._lengths.sum())

    @property
    def transitions(self) -> int:
        """Pairs of a frame and the next one."""
        return self.n_frames - len(self)

    @property
    def lengths(self) -> Tensor:
        """Frames of each episode, int64 [N]."""
        return self._lengths

    @property
    def starts(self) -> Tensor:
        """Number of each episode's first frame, for :meth:`frames`, int64 [N]."""
        return self._starts

    @property
    def instructions(self) -> Tensor:
        """Token ids of each episode's instruction, int64 [N, L]."""
        return self.tokens.long()

    @property
    def image_shape(self) -> tuple[int, int, int]:
        """(C, H, W)."""
        return self.codec.image_shape

    @property
    def tile_size(self) -> int | None:
        """Side of the codec's tiles in pixels; None where it is raw."""
        return self.codec.tile_size

    @property
    def instruction_length(self) -> int:
        """Tokens per instruction, padding included."""
        return self.tokens.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes of codes, tiles, tokens and lengths."""
        tiles = self.codec.tiles
        own = (self.codes, self.tokens, self._lengths, self._starts, self._transition_ends)
        return sum(part.nbytes for part in own) + (0 if tiles is None else tiles.nbytes)

    def sentences(self) -> list[str]:
        """Return the instructions as text."""
        if self.vocabulary is None:
            raise UserError("these demonstrations came without a vocabulary")
        return self.vocabulary.decode(self.instructions)

    def pool(self) -> Tensor:
        """Return the distinct instructions, int64 [P, L]."""
        return distinct_rows(self.tokens).long()

    # ---- Episodes ---------------------------------------------------------------------------

    @overload
    def __getitem__(self, index: int) -> TensorDict: ...
    @overload
    def __getitem__(self, index: slice | Tensor | Sequence[int]) -> Demonstrations: ...
    def __getitem__(self, index: Any) -> TensorDict | Demonstrations:
        """Return one demonstration, a TensorDict [T + 1], or a selection that shares the frames."""
        if isinstance(index, str | tuple):
            raise UserError(
                f"demonstrations have no entry {index!r}: they hold pixels and instructions, which "
                "demos[i], frames, instructions and the sample methods return"
            )
        if not isinstance(index, slice) and not np.ndim(index):
            index = whole("the number of a demonstration", index)
            if not -len(self) <= index < len(self):
                raise IndexError(f"demonstration {index} of {len(self)}")
            first, length = int(self._starts[index]), int(self._lengths[index])
            tokens = self.tokens[index].long().expand(length, -1)
            pixels = self.frames(torch.arange(first, first + length))
            return TensorDict({keys.PIXELS: pixels, keys.INSTRUCTION: tokens}, [length])
        if isinstance(index, slice) and (index.step or 1) < 0:  # tensors know no such slices
            index = list(range(len(self))[index])
        if not isinstance(index, slice):
            index = torch.as_tensor(index).cpu()
            index = index if index.dtype == torch.bool else index.long()
        chosen = copy.copy(self)
        chosen._set_episodes(self._starts[index], self._lengths[index], self.tokens[index])
        return chosen

    def split(self, fraction: float, seed: int = 0) -> tuple[Demonstrations, Demonstrations]:
        """Set a random ``fraction`` of the episodes aside: (the others, those)."""
        if not 0.0 <= fraction <= 1.0:
            raise UserError(f"fraction must be within 0..1, got {fraction}")
        order = torch.randperm(len(self), generator=seeded(seed, "held-out demonstrations"))
        aside = round(fraction * len(self))
        return self[order[aside:].sort().values], self[order[:aside].sort().values]

    def close_episodes(self) -> Demonstrations:
        """Repeat the last frame of each episode that does not end with a repeated frame.

        For demonstrations recorded without the frame after the stop. It takes for granted that
        demonstrators waste no step: an unchanged frame means that they had stopped.
        """
        last = self._starts + self._lengths - 1
        before = (last - 1).maximum(self._starts)
        open_ended = ~same_rows(self.codes, last, before) | (self._lengths == 1)
        lengths = self._lengths + open_ended
        codes = take(self.codes, row_numbers(self._starts, self._lengths, lengths))
        return Demonstrations(
            self.codec,
            codes,
            lengths,
            self.tokens,
            vocabulary=self.vocabulary,
            vocabulary_size=self.vocabulary_size,
        )

    # ---- Frames -----------------------------------------------------------------------------

    def frames(self, number: Tensor) -> Tensor:
        """Return frames by number [*B] (row of ``codes``), uint8 [*B, C, H, W]."""
        return self.codec.decode(self.codes[number.long().cpu()])

    def first_frames(self, index: Tensor | slice = slice(None)) -> Tensor:
        """Return the first frames of some episodes, uint8 [*B, C, H, W]."""
        return self.frames(self._starts[_on_cpu(index)])

    def last_frames(self, index: Tensor | slice = slice(None)) -> Tensor:
        """Return the last frames of some episodes, uint8 [*B, C, H, W]."""
        return self.frames((self._starts + self._lengths - 1)[_on_cpu(index)])

    def locate(self, transition: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the episode and the number of the first frame of transitions, int64 [*B] each.

        Transitions are numbered episode by episode; all of them by default.
        """
        if transition is None:
            transition = torch.arange(self.transitions)
        episode = torch.searchsorted(self._transition_ends, transition, right=True)
        begin = self._transition_ends[episode] - (self._lengths[episode] - 1)
        return episode, self._starts[episode] + transition - begin

    def sample_transitions(
        self, batch: int, generator: torch.Generator | None = None
    ) -> TensorDict:
        """Draw transitions at random, with repetition.

        Returns:
            A TensorDict [batch] of ``pixels``, ``instruction`` and ``("next", "pixels")``.
        """
        if not self.transitions:
            raise UserError("there are no transitions: no episode has two frames")
        drawn = torch.randint(self.transitions, (batch,), generator=generator)
        episode, frame = self.locate(drawn)
        return TensorDict(
            {
                keys.PIXELS: self.frames(frame),
                keys.INSTRUCTION: self.tokens[episode].long(),
                keys.NEXT: {keys.PIXELS: self.frames(frame + 1)},
            },
            [batch],
        )

    def sample_episodes(self, n: int, generator: torch.Generator | None = None) -> TensorDict:
        """Draw whole demonstrations at random, with repetition.

        Returns:
            A TensorDict [n, T + 1] of ``pixels``, ``instruction``, ``mask`` (true for real frames);
            shorter episodes are padded with their last frame.
        """
        refuse_empty(len(self))
        episode = torch.randint(len(self), (n,), generator=generator)
        lengths = self._lengths[episode].unsqueeze(1)
        time = torch.arange(int(lengths.max()) if n else 0)
        number = self._starts[episode].unsqueeze(1) + time.minimum(lengths - 1)
        tokens = self.tokens[episode].long().unsqueeze(1).expand(-1, len(time), -1)
        return TensorDict(
            {
                keys.PIXELS: self.frames(number),
                keys.INSTRUCTION: tokens,
                MASK: time < lengths,
            },
            [n, len(time)],
        )

    # ---- Files ------------------------------------------------------------------------------

    def save(self, folder: str | Path) -> None:
        """Write a folder of ``.npy`` files and ``meta.json``; of a selection, its frames alone."""
        in_a_row = torch.equal(self._starts, self._lengths.cumsum(0) - self._lengths)
        whole = in_a_row and self.n_frames == len(self.codes)
        rows = row_numbers(self._starts, self._lengths)
        codes = self.codes if whole else take(self.codes, rows)
        arrays = {"codes": codes, "lengths": self._lengths, "instructions": self.tokens}
        if self.codec.tiles is not None:
            arrays["tiles"] = self.codec.tiles
        words = None if self.vocabulary is None else list(self.vocabulary.words)
        facts = {
            "image_shape": list(self.image_shape),
            "words": words,
            "vocabulary_size": self.vocabulary_size,
        }
        save_folder(folder, KIND, VERSION, arrays, facts)

    @classmethod
    def load(cls, folder: str | Path) -> Demonstrations:
        """Read what :meth:`save` wrote; frames stay on disk until they are used.

        Raises:
            UserError: where the folder is damaged, truncated or foreign, with what is wrong.
        """
        arrays, facts = load_folder(
            folder, KIND, VERSION, ("codes", "lengths", "instructions"), ("tiles",)
        )
        try:
            words = fact(facts, "words", (list, type(None)))
            tokens = arrays["instructions"]
            vocabulary = None if words is None else Vocabulary(words, tokens.shape[-1])
            return cls(
                FrameCodec(fact(facts, "image_shape", list), arrays.get("tiles")),
                arrays["codes"],
                arrays["lengths"],
                tokens,
                vocabulary=vocabulary,
                vocabulary_size=fact(facts, "vocabulary_size", int),
            )
        except DAMAGED as error:
            raise UserError(f"{folder} is damaged: {error}") from None


def _padded(instructions: Tensor, vocabulary: Vocabulary) -> Tensor:
    """Return instructions as long as those that a vocabulary makes."""
    missing = vocabulary.length - instructions.shape[-1] if instructions.ndim == 2 else 0
    if missing < 0:
        raise UserError(
            f"instructions have {instructions.shape[-1]} tokens, those of the vocabulary "
            f"{vocabulary.length}: make it with length={instructions.shape[-1]}"
        )
    return F.pad(instructions, (0, missing)) if missing else instructions


def _on_cpu(index: Any) -> Any:
    """Return an index of what lies in main memory, whatever kind it is of."""
    return index.cpu() if isinstance(index, Tensor) else index
