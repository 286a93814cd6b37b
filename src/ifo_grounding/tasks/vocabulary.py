"""Words and their token ids. The only part of ``tasks`` that a learner may know."""

from __future__ import annotations

import functools
import unicodedata
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ifo_grounding.errors import UserError, check_below, check_choice, whole
from ifo_grounding.keys import INSTRUCTION_LENGTH
from ifo_grounding.texts import one_line

PAD = 0
MOST_WORDS = 512
"""Words that an instruction may have at most: all are padded to the longest."""


@dataclass(frozen=True)
class Vocabulary:
    """Two-way table of words and token ids; id 0 pads.

    Sentences are normalised by :func:`words_of` before their words are looked up, unless the
    vocabulary's own words keep punctuation that this takes away: such a vocabulary, of recordings
    that were made so, splits sentences at spaces only.

    >>> vocabulary = Vocabulary(["move", "to", "the", "red", "circle"], length=6)
    >>> tokens = vocabulary.encode(["Move to the red circle!"])
    >>> tokens.tolist(), vocabulary.decode(tokens)
    ([[1, 2, 3, 4, 5, 0]], ['move to the red circle'])
    """

    words: Sequence[str]
    """Distinct lower-case words; the first has id 1."""
    length: int = INSTRUCTION_LENGTH
    """Tokens per instruction, padding included."""

    def __post_init__(self) -> None:
        words = tuple(unicodedata.normalize("NFC", word) for word in self.words)
        object.__setattr__(self, "words", words)
        object.__setattr__(self, "length", whole("length", self.length))
        if not 1 <= self.length <= MOST_WORDS:
            raise UserError(f"length must be 1..{MOST_WORDS} words, got {self.length}")
        if len(self._ids) != len(words):
            raise UserError("a vocabulary must not hold a word twice")
        if bad := [word for word in words if word.lower().split() != [word]]:
            raise UserError(f"words must be lower case without spaces, got {bad[0]!r}")
        if bad := [word for word in words if one_line(word) != word]:
            raise UserError(f"words must be of characters that can be printed, got {bad[0]!r}")

    @functools.cached_property
    def _ids(self) -> dict[str, int]:
        return {word: number for number, word in enumerate(self.words, start=1)}

    @functools.cached_property
    def punctuation(self) -> bool:
        """Whether words keep the punctuation around them."""
        return any(words_of(word) != [word] for word in self.words)

    @classmethod
    def from_sentences(
        cls,
        sentences: Iterable[str],
        length: int = INSTRUCTION_LENGTH,
        *,
        punctuation: bool = False,
    ) -> Vocabulary:
        """Collect the distinct words of sentences, by :func:`words_of`, in alphabetical order."""
        return cls(sorted({word for s in sentences for word in words_of(s, punctuation)}), length)

    def __len__(self) -> int:
        """Count the token ids, padding included."""
        return len(self.words) + 1

    def encode(self, sentences: Sequence[str] | str, *, skip_unknown: bool = False) -> Tensor:
        """Turn sentences into token ids, int64 [N, length].

        Args:
            skip_unknown: whether to leave out what the vocabulary has no place for: unknown words,
                with a warning for each, of which a sentence may consist, and those beyond its
                length.

        Raises:
            UserError: where a word is unknown, or a sentence is empty or too long.
        """
        check_choice("skip_unknown", skip_unknown, (True, False))
        if isinstance(sentences, str):
            sentences = [sentences]
        tokens = torch.full((len(sentences), self.length), PAD, dtype=torch.int64)
        for row, sentence in enumerate(sentences):
            words = words_of(sentence, self.punctuation)
            unknown = [word for word in words if word not in self._ids]
            if skip_unknown and words:
                for word in unknown:
                    warnings.warn(f"no demonstration says {word!r}: it is left out", stacklevel=2)
                words = [word for word in words if word in self._ids][: self.length]
            elif unknown:
                raise UserError(
                    f"unknown word {unknown[0]!r} in {sentence!r}: the vocabulary holds "
                    + ", ".join(self.words)
                )
            elif not 0 < len(words) <= self.length:
                raise UserError(
                    f"{sentence!r} has {len(words)} words: an instruction has 1 to {self.length}"
                )
            ids = [self._ids[word] for word in words]
            tokens[row, : len(ids)] = torch.tensor(ids)
        return tokens

    def decode(self, tokens: Tensor) -> list[str]:
        """Turn token ids [N, length] (or [length]) into sentences.

        Raises:
            UserError: for an id that is no word's.
        """
        table = ("", *self.words)
        check_below("the vocabulary has no token", tokens, len(table))
        rows = tokens.reshape(-1, tokens.shape[-1]).tolist()
        return [" ".join(table[token] for token in row if token != PAD) for row in rows]


def check_vocabulary(given: object) -> None:
    """Refuse what is no vocabulary, such as a list of words."""
    if not isinstance(given, Vocabulary):
        raise UserError(
            "vocabulary is a Vocabulary, such as that of the demonstrations or "
            f"Vocabulary.from_sentences(...), got {type(given).__name__}"
        )


def words_of(sentence: str, punctuation: bool = False) -> list[str]:
    """Return the words of a sentence: lower case, without the punctuation around them.

    Punctuation inside of words stays, what is punctuation alone is left out, and a letter and its
    accent are one character (NFC), however they were written.

    Args:
        punctuation: whether the punctuation around words stays, too.

    >>> words_of("  Pick-up Ann's RED ball, then stop ...")
    ['pick-up', "ann's", 'red', 'ball', 'then', 'stop']
    """
    words = unicodedata.normalize("NFC", sentence).lower().split()
    if punctuation:
        return words
    return [bare for word in words if (bare := word.strip("".join(filter(_is_mark, word))))]


def _is_mark(character: str) -> bool:
    return unicodedata.category(character).startswith("P")


WORDS = (
    *("circle", "rectangle", "diamond", "triangle", "red", "yellow", "blue"),
    *("orange", "green", "purple", "pink", "brown", "gray", "cyan"),
    *("the", "box", "cell", "above", "below", "left", "right", "of", "to", "from"),
    *("in", "into", "inside", "out", "and", "it", "up", "arm"),
    *("move", "go", "put", "place", "drop", "pick", "take", "bring", "carry", "transfer"),
    *("shift", "get", "remove", "pull", "lift"),
)
VOCABULARY = Vocabulary(WORDS)
"""All words that the five tasks use, so that one network fits each of them."""
