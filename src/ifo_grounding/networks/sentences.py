"""From words to features: each distinct instruction of a batch is read once."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.distinct import distinct_rows
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.modules import hidden_from_python, is_traced
from ifo_grounding.networks.cells import look_up
from ifo_grounding.networks.config import POOLINGS


def without_padding(tokens: Tensor, words: int) -> Tensor:
    """Cut [N, L], of at least one id, behind the end of the longest of its instructions.

    Raises:
        UserError: where an id is none of so many words.
    """
    lowest, highest = tokens.aminmax()
    if lowest < 0 or highest >= words:
        raise UserError(
            f"instructions hold token ids from {int(lowest)} to {int(highest)}, but this "
            f"network knows 0 to {words - 1}: build it with the vocabulary of the data"
        )
    return tokens[:, : max(int(sentence_lengths(tokens).max()), 1)]


class InstructionEncoder(nn.Module):
    """Base of the encoders of instructions: each distinct instruction of a batch is encoded once.

    Padding, id 0 at the end, changes nothing. On a GPU all instructions are encoded, for to find
    out which are distinct is to wait for it.
    """

    def __init__(self, vocabulary_size: int, embedding: int, hidden: int) -> None:
        super().__init__()
        self.hidden = hidden
        self.size = 2 * hidden
        self.embedding = nn.Embedding(vocabulary_size, embedding, padding_idx=0)

    def forward(self, tokens: Tensor) -> Tensor:
        """Map token ids [N, L] to features [N, size].

        Raises:
            UserError: where an id lies outside the vocabulary; on a GPU, which would have to be
                waited for, CUDA raises.
        """
        if (tokens.is_cuda and tokens.numel()) or hidden_from_python(tokens):
            return self._encode(tokens.long())
        return look_up(*self.distinct(tokens))

    def distinct(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Encode the distinct instructions of [N, L]: features [U, size], and which is whose.

        Raises:
            UserError: where an id lies outside the vocabulary.
        """
        distinct, inverse = distinct_rows(tokens.long())
        if not distinct.numel():
            return self.embedding.weight.new_zeros(len(distinct), self.size), inverse
        distinct = without_padding(distinct, self.embedding.num_embeddings)
        return self._encode_distinct(distinct), inverse

    def _encode(self, tokens: Tensor) -> Tensor:
        raise NotImplementedError

    def _encode_distinct(self, tokens: Tensor) -> Tensor:
        """Encode instructions [U, L] of which no two are the same."""
        return self._encode(tokens)


class ConvInstructionEncoder(InstructionEncoder):
    """Word embeddings, two convolutions over five words each, the maximum over words.

    As good as the GRU here, and several times faster where a batch holds many instructions.

    >>> encoder = ConvInstructionEncoder(vocabulary_size=40, embedding=32, hidden=64)
    >>> encoder(torch.randint(40, (5, 16))).shape
    torch.Size([5, 128])
    """

    def __init__(self, vocabulary_size: int, embedding: int, hidden: int) -> None:
        super().__init__(vocabulary_size, embedding, hidden)
        self.first = nn.Conv1d(embedding, hidden, 5, padding=2)
        self.second = nn.Conv1d(hidden, hidden, 5, padding=2)
        self.out = nn.Linear(hidden, self.size)

    def _encode(self, tokens: Tensor) -> Tensor:
        """Encode rows of ids [N, L], of which trailing zeros do not count."""
        step = torch.arange(tokens.shape[1], device=tokens.device)
        alive = (step < sentence_lengths(tokens).unsqueeze(1)).unsqueeze(-1)
        words = self.embedding(tokens) * alive
        words = F.relu(over_words(self.first, words)) * alive
        return self.out((F.relu(over_words(self.second, words)) * alive).amax(-2))


def over_words(layer: nn.Conv1d, words: Tensor) -> Tensor:
    """Convolve [N, L, D] over its words, as an image of one row: on a CPU nearly twice as fast."""
    row = words.movedim(-1, -2).unsqueeze(-2)  # [N, D, 1, L], channels last in memory
    padding = (0, layer.kernel_size[0] // 2)
    out = F.conv2d(row, layer.weight.unsqueeze(2), layer.bias, padding=padding)
    return out.squeeze(-2).movedim(-2, -1)


WORD_GAIN = 2.0
"""Standard deviation of what a GRU hears of a word to begin with, by that of its embedding."""
ENOUGH_TO_SHARE = 128
"""Sentences from which on it pays to look for what they begin with alike."""


class GRUInstructionEncoder(InstructionEncoder):
    """Word embeddings and a bidirectional GRU (the paper's experimental settings).

    The feature is the mean of the states after every word, the forward ones beside the backward
    ones, or only the last of each way, after which words in the middle of a long sentence are
    hardly heard to begin with; or both of these. An instruction of padding alone is zeros.

    The recurrence is written out, where ``nn.GRU`` would do, because packed sequences do not work
    under ``torch.vmap``, which TorchRL's value estimators use. On a GPU cuDNN computes it where
    nothing traces it.

    It begins with orthogonal recurrences (Saxe et al. 2014) and large weights of words:
    PyTorch's own, which are smaller, would make all sentences nearly the same to begin with.

    Args:
        vocabulary_size: number of token ids.
        embedding: size of a word's embedding.
        hidden: size of the state, each way.
        rate: how fast it learns, by the rest of a network: weights are kept divided by it.
        pooling: ``"mean"``, ``"last"`` or ``"both"``: which states make the feature, of size
            2 * hidden; for both, beside one another each way, 4 * hidden.

    >>> encoder = GRUInstructionEncoder(vocabulary_size=40, embedding=8, hidden=64)
    >>> encoder(torch.randint(40, (5, 16))).shape
    torch.Size([5, 128])
    """

    def __init__(
        self,
        vocabulary_size: int,
        embedding: int,
        hidden: int,
        rate: float = 1.0,
        pooling: str = "last",
    ) -> None:
        super().__init__(vocabulary_size, embedding, hidden)
        self.rate = rate
        check_choice("pooling", pooling, POOLINGS)
        self.pooling = pooling
        if pooling == "both":
            self.size *= 2
        self.input_weight = nn.Parameter(torch.empty(2, embedding, 3 * hidden))
        self.input_bias = nn.Parameter(torch.zeros(2, 1, 3 * hidden))
        self.state_weight = nn.Parameter(torch.empty(2, hidden, 3 * hidden))
        self.state_bias = nn.Parameter(torch.zeros(2, 1, 3 * hidden))
        nn.init.normal_(self.input_weight, std=WORD_GAIN / math.sqrt(embedding))
        for way in self.state_weight.detach():
            for part in way.chunk(3, -1):
                nn.init.orthogonal_(part)
        for weight in self.parameters():
            weight.detach().div_(rate)

    def _encode(self, tokens: Tensor) -> Tensor:
        """Run the GRU both ways over rows of ids [N, L], of which trailing zeros do not count."""
        lengths = sentence_lengths(tokens)
        step = torch.arange(tokens.shape[1], device=tokens.device)
        table, weight, bias = self._scaled()
        alive = (step < lengths.unsqueeze(1)).unsqueeze(-1)
        if tokens.is_cuda and not is_traced(tokens):
            return self._encode_at_once(tokens, lengths, alive)
        ways = zip(both_ways(tokens, lengths), table, strict=True)
        gates = torch.stack([F.embedding(words, known) for words, known in ways])
        state = total = gates.new_zeros(2, len(tokens), self.hidden)
        # Split once: each slice of its own would get a gradient as large as the whole.
        for given, counts in zip(gates.unbind(2), alive.unbind(1), strict=True):
            recalled = torch.baddbmm(bias, state, weight)
            state = torch.where(counts, self._cell(given, recalled, state), state)
            total = total if self.pooling == "last" else total + state * counts
        return torch.cat(self._pooled(self._kept(state, total), lengths).unbind(), -1)

    def _encode_at_once(self, tokens: Tensor, lengths: Tensor, alive: Tensor) -> Tensor:
        """Do as :meth:`_encode` by PyTorch's own GRU, which is one call each way.

        Args:
            tokens: ids [N, L].
            lengths: how many of each row count [N].
            alive: which they are, bool [N, L, 1].
        """
        of_words = self.rate * self.embedding.weight
        matrices = self.input_weight.mT, self.state_weight.mT
        biases = self.input_bias.squeeze(1), self.state_bias.squeeze(1)
        begin = self.embedding.weight.new_zeros(1, len(tokens), self.hidden)
        last = (lengths - 1).clamp_min(0).view(-1, 1, 1).expand(-1, 1, self.hidden)
        encoded = []
        for words, *way in zip(both_ways(tokens, lengths), *matrices, *biases, strict=True):
            # In one piece of memory, as cuDNN wants them.
            flat = self.rate * torch.cat([part.flatten() for part in way])
            pieces = flat.split([part.numel() for part in way])
            states, _ = torch.gru(
                F.embedding(words, of_words),
                begin,
                [piece.view(part.shape) for piece, part in zip(pieces, way, strict=True)],
                has_biases=True,
                num_layers=1,
                dropout=0.0,
                train=torch.is_grad_enabled(),  # cuDNN then keeps what a gradient needs
                bidirectional=False,
                batch_first=True,
            )
            counted = states * alive
            state = counted.gather(1, last).squeeze(1)
            encoded.append(self._pooled(self._kept(state, counted.sum(1)), lengths))
        return torch.cat(encoded, -1)

    def _encode_distinct(self, tokens: Tensor) -> Tensor:
        """Run the GRU once over what sentences begin with, or end with, alike."""
        if tokens.device.type != "cpu" or len(tokens) < ENOUGH_TO_SHARE:
            return self._encode(tokens)
        lengths = sentence_lengths(tokens)
        ways = zip(both_ways(tokens, lengths), *self._scaled(), strict=True)
        return torch.cat([self._one_way(words, lengths, *known) for words, *known in ways], -1)

    def _one_way(
        self, tokens: Tensor, lengths: Tensor, table: Tensor, weight: Tensor, bias: Tensor
    ) -> Tensor:
        """Run one way over rows of ids, each beginning that they have in common once."""
        steps, ends = beginnings(tokens, lengths)
        state = total = table.new_zeros(1, self.hidden)
        kept = [self._kept(state, total)]
        for word, before in steps:
            state = look_up(state, before)
            recalled = torch.addmm(bias, state, weight)
            state = self._cell(look_up(table, word), recalled, state)
            total = total if self.pooling == "last" else look_up(total, before) + state
            kept.append(self._kept(state, total))
        return self._pooled(look_up(torch.cat(kept), ends), lengths)

    def _kept(self, state: Tensor, total: Tensor) -> Tensor:
        """Return what counts of the last state and the sum of all."""
        if self.pooling == "both":
            return torch.cat([state, total], -1)
        return total if self.pooling == "mean" else state

    def _pooled(self, kept: Tensor, lengths: Tensor) -> Tensor:
        """Return the feature of one way or both, from what counts of its states, [..., N, size]."""
        if self.pooling == "last":
            return kept
        count = lengths.clamp_min(1).unsqueeze(-1).to(kept.dtype)
        if self.pooling == "mean":
            return kept / count
        state, total = kept.chunk(2, -1)
        return torch.cat([state, total / count], -1)

    def _scaled(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return W x + b of each word, U and c, as ``nn.GRUCell`` calls them, each way."""
        words = (self.rate * self.embedding.weight).expand(2, -1, -1)
        table = torch.baddbmm(self.rate * self.input_bias, words, self.rate * self.input_weight)
        return table, self.rate * self.state_weight, self.rate * self.state_bias

    def _cell(self, given: Tensor, recalled: Tensor, state: Tensor) -> Tensor:
        """One step of a GRU, as ``nn.GRUCell`` defines it, from W x + b and U h + c for r, z, n."""
        parts = 2 * self.hidden, self.hidden
        (gates, heard), (opened, recalled) = given.split(parts, -1), recalled.split(parts, -1)
        reset, keep = torch.sigmoid(gates + opened).chunk(2, -1)
        return torch.lerp(torch.tanh(heard + reset * recalled), state, keep)


def both_ways(tokens: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Return rows of ids [N, L], and the same from the last that counts to the first."""
    step = torch.arange(tokens.shape[1], device=tokens.device)
    return tokens, tokens.gather(1, (lengths.unsqueeze(1) - 1 - step).clamp_min(0))


def beginnings(tokens: Tensor, lengths: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
    """Find what sentences begin with, each beginning once: a tree of words.

    Args:
        tokens: ids, int64 [N, L].
        lengths: how many of each row count, int64 [N].

    Returns:
        For each word of a sentence the different beginnings that end with it: their last word and
        which of those one word shorter comes before it, int64 [B] each. And which of all
        beginnings each sentence is, int64 [N], the empty one counted first.

    >>> tokens = torch.tensor([[5, 6, 7], [5, 6, 8], [5, 9, 0]])
    >>> steps, ends = beginnings(tokens, torch.tensor([3, 3, 2]))
    >>> [word.tolist() for word, _ in steps], [before.tolist() for _, before in steps]
    ([[5], [6, 9], [7, 8]], [[0], [0, 0], [0, 0]])
    >>> ends.tolist()
    [4, 5, 3]
    """
    words = int(tokens.max()) + 1
    rows = torch.arange(len(tokens), device=tokens.device)
    at = torch.zeros_like(lengths)
    first = [0, 1]
    steps: list[tuple[Tensor, Tensor]] = []
    for place in range(int(lengths.max())):
        rows = rows[lengths[rows] > place]
        found, at[rows] = torch.unique(at[rows] * words + tokens[rows, place], return_inverse=True)
        steps.append((found % words, found // words))
        first.append(first[-1] + len(found))
    return steps, at + torch.tensor(first, device=at.device)[lengths]


def sentence_lengths(tokens: Tensor) -> Tensor:
    """Return the number of ids of each row up to the last that is not padding."""
    place = torch.arange(1, tokens.shape[-1] + 1, device=tokens.device)
    return torch.where(tokens != 0, place, 0).amax(-1)
