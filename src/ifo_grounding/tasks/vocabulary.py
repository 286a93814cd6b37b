"""Words and their token ids. The only part of ``tasks`` that a learner may know."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from ifo_grounding.errors import UserError
from ifo_grounding.keys import INSTRUCTION_LENGTH

PAD = 0


class Vocabulary:
    """Two-way table of words and token ids; id 0 pads.

    Sentences are normalised by :func:`words_of` before their words are looked up, unless the
    vocabulary's own words keep punctuation that this takes away: such a vocabulary, of recordings
    that were made so, splits sentences at spaces only.

    Args:
        words: distinct lower-case words; the first gets id 1.
        length: tokens per instruction, padding included.

    >>> vocabulary = Vocabulary(["move", "to", "the", "red", "circle"], length=6)
    >>> tokens = vocabulary.encode(["Move to the red circle!"])
    >>> tokens.tolist(), vocabulary.decode(tokens)
    ([[1, 2, 3, 4, 5, 0]], ['move to the red circle'])
    """

    def __init__(self, words: Sequence[str], length: int = INSTRUCTION_LENGTH) -> None:
        self.words = tuple(unicodedata.normalize("NFC", word) for word in words)
        self.length = length
        self.punctuation = any(words_of(word) != [word] for word in self.words)
        """Whether words keep the punctuation around them."""
        self._ids = {word: number for number, word in enumerate(self.words, start=1)}
        if len(self._ids) != len(self.words):
            raise UserError("a vocabulary must not hold a word twice")
        if bad := [word for word in self.words if word.lower().split() != [word]]:
            raise UserError(f"words must be lower case without spaces, got {bad[0]!r}")

    @classmethod
    def from_sentences(
        cls, sentences: Iterable[str], length: int = INSTRUCTION_LENGTH
    ) -> Vocabulary:
        """Collect the distinct words of sentences, in alphabetical order."""
        return cls(sorted({word for s in sentences for word in words_of(s)}), length)

    def __len__(self) -> int:
        """Count the token ids, padding included."""
        return len(self.words) + 1

    def __eq__(self, other: object) -> bool:
        """Compare words and length."""
        if not isinstance(other, Vocabulary):
            return NotImplemented
        return self.words == other.words and self.length == other.length

    def __hash__(self) -> int:
        """Hash words and length."""
        return hash((self.words, self.length))

    def encode(self, sentences: Sequence[str] | str, *, skip_unknown: bool = False) -> Tensor:
        """Turn sentences into token ids, int64 [N, length].

        Args:
            sentences: one or several.
            skip_unknown: whether to leave unknown words out.

        Raises:
            UserError: where a word is unknown, or a sentence is empty or too long.
        """
        if isinstance(sentences, str):
            sentences = [sentences]
        tokens = torch.full((len(sentences), self.length), PAD, dtype=torch.int64)
        for row, sentence in enumerate(sentences):
            words = words_of(sentence, self.punctuation)
            if skip_unknown:
                words = [word for word in words if word in self._ids]
            ids = [self._id(word, sentence) for word in words]
            if not 0 < len(ids) <= self.length:
                raise UserError(
                    f"{sentence!r} has {len(ids)} words: an instruction has 1 to {self.length}"
                )
            tokens[row, : len(ids)] = torch.tensor(ids)
        return tokens

    def decode(self, tokens: Tensor) -> list[str]:
        """Turn token ids [N, length] (or [length]) into sentences.

        Raises:
            UserError: for an id that is no word's.
        """
        table = ("", *self.words)
        if tokens.numel():
            low, high = (int(token) for token in tokens.aminmax())
            if low < 0 or high >= len(table):
                raise UserError(
                    f"token {low if low < 0 else high} is no word: this vocabulary has ids "
                    f"0..{len(table) - 1}"
                )
        rows = tokens.reshape(-1, tokens.shape[-1]).tolist()
        return [" ".join(table[token] for token in row if token != PAD) for row in rows]

    def _id(self, word: str, sentence: str) -> int:
        if word not in self._ids:
            raise UserError(
                f"unknown word {word!r} in {sentence!r}: the vocabulary holds "
                + ", ".join(self.words)
            )
        return self._ids[word]


def words_of(sentence: str, punctuation: bool = False) -> list[str]:
    """Return the words of a sentence: lower case, without the punctuation around them.

    Punctuation inside of words stays, what is punctuation alone is left out, and a letter and its
    accent are one character (NFC), however they were written.

    Args:
        sentence: any text.
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
