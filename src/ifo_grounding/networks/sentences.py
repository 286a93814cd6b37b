"""From words to features: the paper's encoder of instructions."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.distinct import distinct_rows
from ifo_grounding.errors import UserError, check_below
from ifo_grounding.networks.cells import look_up

WORD_GAIN = 2.0
"""Initial standard deviation of what a GRU hears of a word, relative to its embedding's."""


class GRUInstructionEncoder(nn.Module):
    """Word embeddings and a bidirectional GRU (the paper's experimental settings).

    The feature is the mean of the states after every word, the forward ones beside the backward
    ones, or only the last of each way, in which initial weights keep hardly anything of the words
    in the middle of a long sentence. Padding, id 0 at the end, changes nothing; an instruction of
    padding alone is zeros.

    On a CPU what several instructions of a batch begin or end with alike is encoded once. On a GPU,
    which would have to be waited for to find it, PyTorch's GRU reads all of them.

    Initial recurrences are orthogonal (Saxe et al. 2014) and initial weights of words large:
    PyTorch's own, which are smaller, would make all sentences nearly the same.

    Args:
        hidden: size of the state, each way.
        rate: how fast it learns, relative to the rest of a network: weights are kept divided by it.
        pooling: ``"mean"`` or ``"last"``: which states make the feature, of size 2 * hidden.
    """

    def __init__(
        self,
        vocabulary_size: int,
        embedding: int,
        hidden: int,
        rate: float = 1.0,
        pooling: str = "mean",
    ) -> None:
        super().__init__()
        self.hidden, self.size = hidden, 2 * hidden
        self.rate, self.pooling = rate, pooling
        self.embedding = nn.Embedding(vocabulary_size, embedding, padding_idx=0)
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

    def forward(self, tokens: Tensor) -> Tensor:
        """Map token ids [*B, L] to features [*B, size], float32 inside ``torch.autocast`` too.

        Raises:
            UserError: where an id lies outside the vocabulary; on a GPU, CUDA raises.
        """
        rows = rows_of_ids(tokens)
        with torch.autocast(tokens.device.type, enabled=False):  # too small to gain from bf16
            if not rows.numel():
                encoded = self.embedding.weight.new_zeros(len(rows), self.size)
            elif rows.is_cuda:
                encoded = self._encode_all(rows)
            else:
                rows, which = distinct_rows(rows)
                rows = without_padding(rows, self.embedding.num_embeddings)
                encoded = look_up(self._encode_distinct(rows), which)
        return encoded.reshape(*tokens.shape[:-1], self.size)

    def _encode_all(self, tokens: Tensor) -> Tensor:
        """Encode every row of ids [N, L] by PyTorch's own GRU, one call each way."""
        lengths = sentence_lengths(tokens)
        alive = (torch.arange(tokens.shape[1], device=tokens.device) < lengths[:, None])[..., None]
        of_words = self.rate * self.embedding.weight
        matrices = self.input_weight.mT, self.state_weight.mT
        biases = self.input_bias.squeeze(1), self.state_bias.squeeze(1)
        start = self.embedding.weight.new_zeros(1, len(tokens), self.hidden)
        last = (lengths - 1).clamp_min(0).view(-1, 1, 1).expand(-1, 1, self.hidden)
        encoded = []
        both_ways = tokens, backwards(tokens, lengths)
        for words, *way in zip(both_ways, *matrices, *biases, strict=True):
            # In one piece of memory, as cuDNN wants them.
            flat = self.rate * torch.cat([part.flatten() for part in way])
            pieces = flat.split([part.numel() for part in way])
            states, _ = torch.gru(
                F.embedding(words, of_words),
                start,
                [piece.view(part.shape) for piece, part in zip(pieces, way, strict=True)],
                has_biases=True,
                num_layers=1,
                dropout=0.0,
                train=torch.is_grad_enabled(),  # cuDNN then keeps what a gradient needs
                bidirectional=False,
                batch_first=True,
            )
            counted = states * alive
            if self.pooling == "mean":
                encoded.append(counted.sum(1) / lengths.clamp_min(1).unsqueeze(-1))
            else:
                encoded.append(counted.gather(1, last).squeeze(1))
        return torch.cat(encoded, -1)

    def _encode_distinct(self, tokens: Tensor) -> Tensor:
        """Run the GRU once over what rows of ids [U, L] begin with alike, and end with alike."""
        lengths, count = sentence_lengths(tokens), self.embedding.num_embeddings
        # Read backwards, words have numbers and gates of their own.
        both_ways = torch.cat([tokens, backwards(tokens, lengths) + count])
        steps, ends = word_tree(both_ways, lengths.repeat(2))
        of_words = (self.rate * self.embedding.weight).expand(2, -1, -1)
        table = torch.baddbmm(self.rate * self.input_bias, of_words, self.rate * self.input_weight)
        weight, bias = self.rate * self.state_weight, self.rate * self.state_bias
        state = total = table.new_zeros(1, self.hidden)
        kept = [total]
        for word, before in steps:
            forwards = int((word < count).sum())  # of a tree in order, these come first
            state = look_up(state, before)
            parts = zip(bias, state.split([forwards, len(word) - forwards]), weight, strict=True)
            recalled = torch.cat([torch.addmm(*part) for part in parts])
            state = self._cell(look_up(table.flatten(0, 1), word), recalled, state)
            total = look_up(total, before) + state if self.pooling == "mean" else state
            kept.append(total)
        encoded = torch.cat(look_up(torch.cat(kept), ends).chunk(2), -1)
        return encoded / lengths.clamp_min(1).unsqueeze(-1) if self.pooling == "mean" else encoded

    def _cell(self, given: Tensor, recalled: Tensor, state: Tensor) -> Tensor:
        """One step of a GRU, as ``nn.GRUCell`` defines it, from W x + b and U h + c for r, z, n."""
        parts = 2 * self.hidden, self.hidden
        (gates, heard), (opened, recalled) = given.split(parts, -1), recalled.split(parts, -1)
        reset, keep = torch.sigmoid(gates + opened).chunk(2, -1)
        return torch.lerp(torch.tanh(heard + reset * recalled), state, keep)


def word_tree(tokens: Tensor, lengths: Tensor) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
    """Find what rows of ids [N, L], ``lengths`` [N] of each, begin with, once: a tree of words.

    Returns:
        For each length the different beginnings, in order: their last word and which of those one
        word shorter comes before it, int64 [B] each. And which of all beginnings each row is, int64
        [N], the empty one counted first.

    >>> tokens = torch.tensor([[5, 6, 7], [5, 6, 8], [5, 9, 0]])
    >>> steps, ends = word_tree(tokens, torch.tensor([3, 3, 2]))
    >>> [word.tolist() for word, _ in steps], [before.tolist() for _, before in steps]
    ([[5], [6, 9], [7, 8]], [[0], [0, 0], [0, 0]])
    >>> ends.tolist()
    [4, 5, 3]
    """
    step = torch.arange(tokens.shape[1], device=tokens.device)
    padded = tokens.masked_fill(step >= lengths.unsqueeze(1), -1)
    rows, which = torch.unique(padded, dim=0, return_inverse=True)  # in order
    counts = rows >= 0
    differs = F.pad((rows[1:] != rows[:-1]).cumsum(1) > 0, (0, 0, 1, 0), value=True)
    new = differs & counts  # where the row above begins otherwise
    number = F.pad(new.cumsum(0) - 1, (1, 0))  # [U, 1 + L], the empty beginning first
    places = [(new[:, place].nonzero().squeeze(1), place) for place in range(tokens.shape[1])]
    steps = [(rows[row, place], number[row, place]) for row, place in places]
    found = new.sum(0)
    first = F.pad(found.cumsum(0) - found + 1, (1, 0))  # of each length, among all
    ends = (number + first).gather(1, counts.sum(1, keepdim=True)).squeeze(1)
    return steps, ends[which]


def backwards(tokens: Tensor, lengths: Tensor) -> Tensor:
    """Return rows of ids [N, L] from the last that counts to the first."""
    step = torch.arange(tokens.shape[1], device=tokens.device)
    return tokens.gather(1, (lengths.unsqueeze(1) - 1 - step).clamp_min(0))


def sentence_lengths(tokens: Tensor) -> Tensor:
    """Return the number of ids of each row up to the last that is not padding."""
    place = torch.arange(1, tokens.shape[-1] + 1, device=tokens.device)
    return torch.where(tokens != 0, place, 0).amax(-1)


def rows_of_ids(tokens: Tensor) -> Tensor:
    """Return token ids [*B, L] as int64 [N, L], or refuse what is no whole number."""
    if tokens.is_floating_point() or tokens.is_complex() or tokens.dtype == torch.bool:
        raise UserError(f"instructions hold whole token ids, got {tokens.dtype}: give int64")
    return tokens.reshape(-1, tokens.shape[-1]).long()


def without_padding(tokens: Tensor, words: int) -> Tensor:
    """Cut [N, L] behind the end of the longest instruction, or refuse ids of no word.

    Not on a GPU, which would have to be waited for: there CUDA raises.
    """
    if not tokens.numel() or tokens.is_cuda:
        return tokens
    check_below("instructions for this network hold token", tokens, words)
    return tokens[:, : max(int(sentence_lengths(tokens).max()), 1)]
