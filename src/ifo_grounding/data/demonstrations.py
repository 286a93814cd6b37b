"""Demonstrations that show frames and say instructions, and nothing else."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.data._episodes import Episode, Reader, check_parts, padded, rows_of
from ifo_grounding.data._spool import same_rows, take
from ifo_grounding.data.codec import FrameCodec
from ifo_grounding.data.folder import damaged, load_folder, save_folder
from ifo_grounding.errors import UserError, whole
from ifo_grounding.tasks.vocabulary import Vocabulary, check_vocabulary, words_of

KIND = "ifo-grounding demonstrations"
FEW = 1000
"""With fewer demonstrations than this some defaults are other ones, of budgets and rates."""


class Demonstrations:
    """Observation-only demonstrations: frames of episodes in a row, and an instruction for each.

    T actions leave T + 1 frames; the stop repeats the last frame (see :meth:`close_episodes`).
    There is no place for actions. Frames are stored by a :class:`FrameCodec` and decoded when read;
    a slice or a selection shares the frames of the whole.

    Args:
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
    >>> demos[:2].sentences()
    ['go up', 'go up']
    """

    __slots__ = (
        *("codec", "codes", "lengths", "starts"),
        *("tokens", "vocabulary", "vocabulary_size"),
    )
    lengths: Tensor
    """Frames of each episode, int64 [N]."""
    starts: Tensor
    """Number of each episode's first frame, for :meth:`frames`, int64 [N]."""
    tokens: Tensor
    """The instructions in few bytes, integer [N, L]; see :attr:`instructions`."""

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
            check_vocabulary(vocabulary)
            vocabulary_size = len(vocabulary)
            instructions = padded(instructions, vocabulary)
        elif vocabulary_size is None:
            vocabulary_size = int(instructions.max()) + 1 if instructions.numel() else 1
        vocabulary_size = whole("vocabulary_size", vocabulary_size)
        codec.check(codes)
        check_parts(len(codes), lengths, instructions, vocabulary_size)
        self.codec, self.codes, self.lengths = codec, codes, lengths.long()
        self.vocabulary, self.vocabulary_size = vocabulary, vocabulary_size
        self.starts = self.lengths.cumsum(0) - self.lengths
        small = torch.int16 if vocabulary_size <= torch.iinfo(torch.int16).max else torch.int32
        self.tokens = instructions.to(small)

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
            frames: one uint8 array [T + 1, C, H, W] per episode; a generator is read in pieces.
            instructions: token ids, integer [N, L], or sentences.
            vocabulary: the words of the sentences or tokens; by default that of the sentences.
            length: as of :meth:`from_episodes`, where there are sentences.
            tile_size: of the codec; the cheapest one by default.

        Raises:
            UserError: with the number of the episode that is not as it has to be.
        """
        if isinstance(instructions, str):
            raise UserError("instructions are a sentence for each episode, got one text")
        if not isinstance(instructions, Tensor):
            pairs: Iterable[Any] = enumerate(zip_longest(frames, instructions))
            named = ((number, *pair) for number, pair in pairs)
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
            episodes: name, frames and instruction of each; frames are uint8 [T + 1, C, H, W]. True
                as a fourth entry says that the recording was cut: its last frame is no stop, and
                stays as it is. A generator is read once.
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
            sentences, length or max(len(words_of(sentence)) for sentence in sentences)
        )
        tokens = words.encode(sentences)
        return cls(codec, codes, torch.tensor(reader.lengths), tokens, vocabulary=words)

    def __len__(self) -> int:
        return len(self.lengths)

    def __repr__(self) -> str:
        return f"Demonstrations({len(self)} episodes, {self.n_frames} frames, {self.codec})"

    @property
    def n_frames(self) -> int:
        """Frames of all episodes."""
        return int(self.lengths.sum())

    @property
    def transitions(self) -> int:
        """Pairs of a frame and the next one."""
        return self.n_frames - len(self)

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
    def closed(self) -> Tensor:
        """Whether each episode shows its stop, a repeated last frame, bool [N]."""
        last = self.starts + self.lengths - 1
        before = (last - 1).maximum(self.starts)
        return same_rows(self.codes, last, before) & (self.lengths > 1)

    @property
    def cut(self) -> Tensor:
        """Whether each recording was cut before its stop, bool [N]: open ones among closed ones.

        Where all are open, their stops were not recorded, and none counts as cut.
        """
        closed = self.closed
        return ~closed & closed.any()

    def sentences(self) -> list[str]:
        """Return the instructions as text."""
        if self.vocabulary is None:
            raise UserError("these demonstrations came without a vocabulary")
        return self.vocabulary.decode(self.instructions)

    def pool(self) -> Tensor:
        """Return the distinct instructions in lexical order of their tokens, int64 [P, L]."""
        return self.instructions.unique(dim=0)

    @overload
    def __getitem__(self, index: int) -> TensorDict: ...
    @overload
    def __getitem__(self, index: slice | Tensor | Sequence[int]) -> Demonstrations: ...
    def __getitem__(self, index: Any) -> TensorDict | Demonstrations:
        """Return one demonstration, a TensorDict [T + 1], or a selection that shares the frames."""
        if not isinstance(index, slice) and not np.ndim(index):
            index = whole("a demonstration's number", index)
            if not -len(self) <= index < len(self):
                raise IndexError(f"demonstration {index} of {len(self)}")
            first, length = int(self.starts[index]), int(self.lengths[index])
            tokens = self.tokens[index].long().expand(length, -1)
            pixels = self.frames(torch.arange(first, first + length))
            return TensorDict({keys.PIXELS: pixels, keys.INSTRUCTION: tokens}, [length])
        index = list(range(len(self))[index]) if isinstance(index, slice) else index
        index = torch.as_tensor(index).cpu()
        index = index if index.dtype == torch.bool else index.long()
        chosen = copy.copy(self)
        for name in ("starts", "lengths", "tokens"):
            setattr(chosen, name, getattr(self, name)[index])
        return chosen

    def close_episodes(self) -> Demonstrations:
        """Repeat the last frame of each episode that does not end with a repeated frame.

        For demonstrations recorded without the frame after the stop, not for recordings that were
        cut. It takes for granted that demonstrators waste no step: an unchanged frame means that
        they had stopped.
        """
        lengths = self.lengths + ~self.closed
        episode, rows = rows_of(self.starts, lengths)
        codes = take(self.codes, rows.minimum((self.starts + self.lengths - 1)[episode]))
        words: Any = {"vocabulary": self.vocabulary, "vocabulary_size": self.vocabulary_size}
        return Demonstrations(self.codec, codes, lengths, self.tokens, **words)

    def frames(self, number: Tensor) -> Tensor:
        """Return frames by number [*B] (row of ``codes``), uint8 [*B, C, H, W]."""
        return self.codec.decode(self.codes[number.long().cpu()])

    def first_frames(self) -> Tensor:
        """Return the first frame of each episode, uint8 [N, C, H, W]."""
        return self.frames(self.starts)

    def locate(self) -> tuple[Tensor, Tensor]:
        """Return the episode and the number of the first frame of all transitions, int64 [M] each.

        Transitions are numbered episode by episode.
        """
        return rows_of(self.starts, self.lengths - 1)

    def save(self, folder: str | Path) -> None:
        """Write a folder of ``.npy`` files and ``meta.json``; of a selection, its frames alone."""
        _, rows = rows_of(self.starts, self.lengths)
        in_a_row = torch.equal(rows, torch.arange(len(self.codes)))
        codes = self.codes if in_a_row else take(self.codes, rows)
        arrays = {"codes": codes, "lengths": self.lengths, "instructions": self.tokens}
        if self.codec.tiles is not None:
            arrays["tiles"] = self.codec.tiles
        facts = {
            "image_shape": list(self.image_shape),
            "words": None if self.vocabulary is None else list(self.vocabulary.words),
            "vocabulary_size": self.vocabulary_size,
        }
        save_folder(folder, KIND, arrays, facts)

    @classmethod
    def load(cls, folder: str | Path) -> Demonstrations:
        """Read what :meth:`save` wrote; frames stay on disk until they are used.

        Raises:
            UserError: where the folder is damaged, truncated or foreign, with what is wrong.
        """
        names = ("codes", "lengths", "instructions")
        arrays, facts = load_folder(folder, KIND, names, ("tiles",))
        with damaged(folder):
            codes, lengths, tokens = (arrays[name] for name in names)
            codec = FrameCodec(facts["image_shape"], arrays.get("tiles"))
            words, size = facts["words"], facts["vocabulary_size"]
            vocabulary = None if words is None else Vocabulary(words, tokens.shape[-1])
            return cls(codec, codes, lengths, tokens, vocabulary=vocabulary, vocabulary_size=size)
