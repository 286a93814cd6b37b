"""Words that each say something about a cell, so that new combinations of them mean something.

An extension of the paper, whose networks learn each sentence for itself: an object that no
demonstration goes for is never a target, whatever it is called. Here an instruction reaches the
policy only through maps of *where*, to which each word adds its own evidence about each cell; and
walking and stopping see forms and those maps alone.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.distinct import distinct_rows
from ifo_grounding.networks.appearance import EVIDENCE, Appearance, ColourAndForm
from ifo_grounding.networks.cells import cell_places, look_up
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.layers import convolutions
from ifo_grounding.networks.patches import Mosaics
from ifo_grounding.networks.sentences import rows_of_ids, without_padding
from ifo_grounding.networks.shapes import Shapes, grid_of, patch_size

ROLE, SIDE = 8, 4
"""Sizes of the codes from which a word's role and the modifier are read."""
MODIFIER = 8
"""Size of what an instruction says besides places, such as a side."""
FORMS, AROUND = 8, 16
"""Sizes of what is seen of a cell by its neighbours, and of what lies around each cell."""
BEARINGS = 4
"""In how many ways places are read relative to what is seen, such as where the agent faces."""
SWAPPED = 0.8
"""Share of the words that training swaps."""
NOISE = 0.7
"""Standard deviation of what training adds to the code from which the modifier is read."""
PACE = 0.05
"""Share by which each batch of training moves what words usually count."""

MEANING = ("about_colour", "about_form", "side", "around", "modifier")
"""Parts of :class:`WordMaps` that know what words mean; the others know which of them count."""


class WordMaps(nn.Module):
    """Maps of where an instruction points, to which each word adds its evidence.

    A word's evidence about a cell is the sum of what it says of its colours and of its form; how
    much it counts for a map is its role, read from its place among the other words. In training,
    roles are read from instructions whose words were swapped (:func:`swap_words`), so that they
    cannot depend on which colour or form is meant.
    """

    word_penalty: Tensor | None = None
    """Left by each batch of training: over the words that it says, the spread over cells of the
    evidence about colours plus that about form. A loss that adds it makes a word speak about one of
    the two."""
    swaps_words = True
    """Whether training swaps words. While they are still being found, a role that others make
    uncertain can keep them from it."""
    usual: Tensor
    """How much each word usually counts for each map, which tells nothing: [V, maps]."""

    def __init__(self, vocabulary_size: int, maps: int, hidden: int) -> None:
        super().__init__()
        self.about_colour = nn.Embedding(vocabulary_size, EVIDENCE)
        self.about_form = nn.Embedding(vocabulary_size, EVIDENCE)
        for words in (self.about_colour, self.about_form):
            nn.init.normal_(words.weight, std=2 / math.sqrt(EVIDENCE))  # maps are sharp early on
        self.role = nn.Embedding(vocabulary_size, ROLE)
        self.beside = nn.Conv1d(ROLE, hidden, 5, padding=2)
        self.relevance = nn.Conv1d(hidden, maps, 5, padding=2)
        nn.init.normal_(self.relevance.weight, std=1 / math.sqrt(5 * hidden))
        self.relevance.bias.data.zero_()  # type: ignore[union-attr]
        self.side = nn.Embedding(vocabulary_size, SIDE)
        self.around = nn.Conv1d(SIDE, hidden, 5, padding=2)
        self.modifier = nn.Linear(hidden, MODIFIER)
        self.register_buffer("usual", torch.zeros(vocabulary_size, maps))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "word_penalty": None}  # it is a part of a graph

    def forward(self, seen: Appearance, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Return the maps' logits [N, maps, h * w] and the modifier [N, MODIFIER]."""
        used = None
        if not tokens.is_cuda:  # which would have to be waited for
            counts = (self.usual != 0).any(1)
            counts[tokens] = True  # of the others no evidence is needed
            used = counts.nonzero().squeeze(1)
        colour, form = self.evidence(seen, used)
        if self.training or tokens.is_cuda:
            spoken, modifier = self.listen(tokens, used)
        else:
            distinct, which = distinct_rows(tokens)
            spoken, modifier = (look_up(each, which) for each in self.listen(distinct, used))
        if self.training:
            said = torch.zeros(len(self.usual), dtype=torch.bool, device=tokens.device)
            said[tokens] = True
            said[0] = False
            if used is None:
                spreads = _spread(colour, seen.where) + _spread(form, seen.where)
                self.word_penalty = torch.where(said, spreads, 0).sum()
            else:
                colours, forms = colour[:, said[used]], form[:, said[used]]
                self.word_penalty = _spread(colours).sum() + _spread(forms).sum()
        evidence = look_up(colour + form, seen.where)
        return spoken.transpose(1, 2) @ evidence.transpose(1, 2), modifier

    def evidence(self, seen: Appearance, used: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return what words, all or those ``used``, say of colours and of form, [U, V] each."""
        about = [self.about_colour.weight, self.about_form.weight]
        colour, form = about if used is None else [look_up(words, used) for words in about]
        return seen.colour @ colour.T, seen.form @ form.T

    def listen(self, tokens: Tensor, used: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return how much each word counts for each map, [N, V, maps], and [N, MODIFIER].

        What words usually count is taken off: it tells nothing of this instruction. Words of
        ``tokens`` [N, L] that are not ``used``, int64 [V], count nothing.
        """
        weights, modifier = self.roles(tokens)
        usual = self.usual if used is None else self.usual[used]
        if used is not None:
            number = tokens.new_zeros(len(self.usual))
            number[used] = torch.arange(len(used), device=used.device)
            tokens = number[tokens]
        spoken = weights.new_zeros(len(tokens), len(usual), weights.shape[-1])
        spoken = spoken.scatter_add(1, tokens.unsqueeze(-1).expand_as(weights), weights)
        if self.training and len(tokens):
            usual = usual.lerp(spoken.detach().float().mean(0).to(usual.dtype), PACE)
            self.usual[slice(None) if used is None else used] = usual
        return spoken - usual.to(spoken.dtype), modifier

    def roles(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Return how much words count for each map [N, L, maps], and the modifier [N, MODIFIER]."""
        alive = (tokens != 0).unsqueeze(-1)
        swaps = self.training and self.swaps_words
        heard = swap_words(tokens, SWAPPED) if swaps else tokens
        code = torch.tanh(self.role(heard)) * alive
        beside = F.relu(over_words(self.beside, code)) * alive
        relevance = over_words(self.relevance, beside).movedim(-1, 1).softmax(1).movedim(1, -1)
        side = torch.tanh(self.side(tokens))
        if self.training:
            side = side + NOISE * torch.randn_like(side)
        around = F.relu(over_words(self.around, side * alive)) * alive
        return self.relevance.out_channels * relevance * alive, self.modifier(around.amax(-2))


def swap_words(tokens: Tensor, share: float) -> Tensor:
    """Swap a share of the words [N, L] for those of another instruction of the batch, as long.

    >>> tokens = torch.tensor([[1, 2, 3, 0], [1, 5, 6, 0], [7, 0, 0, 0]])
    >>> swap_words(tokens, 1.0).tolist()
    [[1, 5, 6, 0], [1, 2, 3, 0], [7, 0, 0, 0]]
    """
    lengths = (tokens != 0).sum(1)
    order = (lengths + torch.rand(lengths.shape, device=tokens.device)).argsort()
    # The first of each length has a longer or shorter one before it: the last of its own is its.
    place = torch.arange(len(order), device=tokens.device)
    first = lengths[order] != lengths[order.roll(1)]
    group = first.cumsum(0)
    last = place.new_zeros(len(order) + 1).scatter_reduce(0, group, place, "amax")
    before = torch.where(first, last[group], place - 1)
    other = torch.empty_like(order).scatter(0, order, order[before])
    swapped = torch.rand(tokens.shape, device=tokens.device) < share
    return torch.where(swapped, tokens[other], tokens)


class GroundedTrunk(nn.Module):
    """Where an instruction points, where the arm and the like are, and how the two go together.

    Attention maps of two kinds read the image. Those of :class:`WordMaps` give places alone; each
    is read as evidence for and against them, for which of the two finds its target is a matter of
    chance. The others see silhouettes and no words, and give places, what is seen there, and how
    much of each word map lies there. With ``context`` they also give which forms and word maps lie
    around, such as the target before the agent, and all places times a few features of what is
    seen: to whom faces east, what lies in the north is on the left.
    """

    place: Tensor

    def __init__(self, shapes: Shapes, config: NetworkConfig) -> None:
        super().__init__()
        channels = shapes.image_shape[0]
        self.appearance = ColourAndForm(channels, config.features, patch_size(shapes, config))
        self.words = WordMaps(shapes.vocabulary_size, config.maps, config.hidden)
        self.attention = nn.Linear(config.features, config.heads)
        nn.init.normal_(self.attention.weight, std=8 / math.sqrt(config.features))
        self.value = nn.Linear(config.features, config.values)
        self.around: nn.Sequential | None = None
        seen, maps = config.values, 2 * config.maps
        self.size = config.heads * (2 + seen + maps) + 2 * maps + MODIFIER
        if config.context:
            self.form = nn.Linear(config.features, FORMS)
            self.around = convolutions(FORMS + maps, *[AROUND] * config.context)
            known = config.heads * (seen + AROUND)
            self.bearing = nn.Linear(known, BEARINGS)
            nn.init.normal_(self.bearing.weight, std=4 / math.sqrt(known))
            self.size += config.heads * AROUND + BEARINGS * 2 * (config.heads + maps)
        self.grid = grid_of(shapes, config)
        self.register_buffer("place", cell_places(self.grid), persistent=False)

    def forward(self, image: Tensor | Mosaics, tokens: Tensor) -> Tensor:
        """Map an image [N, C, H, W] and token ids [N, L] to [N, size]."""
        cells = self.appearance(image)
        tokens = without_padding(rows_of_ids(tokens), self.words.role.num_embeddings)
        logits, modifier = self.words(cells, tokens)
        maps = weigh(logits)
        silent = torch.cat([self.attention(cells.silhouette), self.value(cells.silhouette)], -1)
        silent = look_up(silent, cells.where)
        if self.around is not None:
            forms = look_up(F.relu(self.form(cells.silhouette)), cells.where)
            shown = torch.cat([forms, maps.transpose(1, 2)], -1)
            silent = torch.cat([silent, surroundings(self.around, shown, self.grid)], -1)
        heads = self.attention.out_features
        attention = silent[..., :heads].transpose(1, 2).softmax(-1)
        place = self.place.to(maps.dtype)
        own, pointed, seen = attention @ place, maps @ place, attention @ silent[..., heads:]
        read = torch.cat([own, seen, attention @ maps.transpose(1, 2)], -1)
        known = [read.flatten(1), pointed.flatten(1), modifier]
        if self.around is not None:
            bearing = torch.tanh(self.bearing(seen.flatten(1)))
            places = torch.cat([own, pointed], 1).flatten(1)
            known.append((bearing.unsqueeze(-1) * places.unsqueeze(1)).flatten(1))
        return torch.cat(known, -1)

    def maps(self, image: Tensor | Mosaics, tokens: Tensor) -> Tensor:
        """Return how each map weighs the cells of an image: [N, 2 * maps, h * w]."""
        logits, _ = self.words(self.appearance(image), tokens.long())
        return weigh(logits)


def weigh(logits: Tensor) -> Tensor:
    """Weigh cells [N, maps, h * w] by evidence for and against them: [N, 2 * maps, h * w]."""
    return torch.cat([logits, -logits], 1).softmax(-1)


def over_words(layer: nn.Conv1d, words: Tensor) -> Tensor:
    """Convolve [N, L, D] over its words, as an image of one row: on a CPU nearly twice as fast."""
    row = words.movedim(-1, -2).unsqueeze(-2)  # [N, D, 1, L], channels last in memory
    padding = (0, layer.kernel_size[0] // 2)
    out = F.conv2d(row, layer.weight.unsqueeze(2), layer.bias, padding=padding)
    return out.squeeze(-2).movedim(-2, -1)


def surroundings(layers: nn.Module, shown: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return what convolutions see around each cell, [N, h * w, AROUND], of [N, h * w, F]."""
    around: Tensor = layers(shown.unflatten(1, grid).movedim(-1, 1))
    return around.flatten(2).transpose(1, 2)


def _spread(evidence: Tensor, where: Tensor | None = None) -> Tensor:
    """Return the standard deviation of [U, V] over the cells that there are, for each word [V].

    Those are all, or the ones that lie somewhere: ``where``, int64 [N, h * w].
    """
    if where is None:
        return evidence.var(0, unbiased=False).add(1e-4).sqrt()
    there = evidence.new_zeros(len(evidence), 1).index_fill(0, where.flatten(), 1)
    there = there / there.sum()
    off = evidence - (there * evidence).sum(0)
    return (there * off**2).sum(0).add(1e-4).sqrt()
