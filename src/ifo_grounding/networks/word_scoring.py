"""Scoring how images and instructions go together, word by word."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.distinct import distinct_rows
from ifo_grounding.networks.appearance import ColourAndForm
from ifo_grounding.networks.cells import Kinds, cell_places, group_cells, look_up
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.grounding import AROUND, FORMS, MODIFIER, WordMaps, surroundings
from ifo_grounding.networks.layers import head
from ifo_grounding.networks.patches import Mosaics
from ifo_grounding.networks.scoring import PairScorer
from ifo_grounding.networks.sentences import rows_of_ids, without_padding
from ifo_grounding.networks.shapes import Shapes, patch_size


class Seen(NamedTuple):
    """What is seen of the distinct cells of an image."""

    said: Tensor
    """What each word says of them, [U, V]."""
    silent: Tensor
    """What the heads and values see that hear no words, [U, heads + values]."""
    forms: Tensor
    """What their neighbours see of them, [U, FORMS]."""
    where: Tensor
    """Which of them lies in each cell, int64 [N, h * w]."""


class WordScorer(PairScorer):
    """Scores images with an instruction of which each word adds its evidence about each cell.

    A cell's features are what every word of the vocabulary says of it, for each image, and what
    silent heads see in all images; an instruction's are how much every word counts for each map.
    Their product are the maps, which tell places, as in ``GroundedTrunk``, what lies around them,
    whether there is one, and how many cells fit.

    A policy asks where the evidence for a word is greatest; a classifier, whether it is enough. So
    each word has a threshold, which shifts what is said of all cells alike: places stay as they
    are, counts do not.
    """

    place: Tensor

    def __init__(self, shapes: Shapes, config: NetworkConfig, images: int = 1) -> None:
        super().__init__(shapes, config, images)
        channels = shapes.image_shape[0]
        self.appearance = ColourAndForm(channels, config.features, patch_size(shapes, config))
        self.words = WordMaps(shapes.vocabulary_size, config.maps, config.hidden)
        self.attention = nn.Linear(images * config.features, config.heads)
        nn.init.normal_(self.attention.weight, std=8 / math.sqrt(config.features))
        self.value = nn.Linear(images * config.features, config.values)
        self.form = nn.Linear(images * config.features, FORMS)
        self.around = nn.Conv2d(FORMS, AROUND, 3, padding=1)
        self.register_buffer("place", cell_places(self.grid), persistent=False)
        self.known = shapes.vocabulary_size
        self.threshold = nn.Parameter(torch.zeros(shapes.vocabulary_size))
        maps = images * config.maps
        self.scale = nn.Parameter(torch.ones(maps))
        self.bias = nn.Parameter(torch.full((maps,), -4.0))  # most cells do not fit
        seen = config.heads * (2 + config.values + 2 * maps)
        self.head = head(seen + 2 * maps * (3 + AROUND) + 2 * maps + MODIFIER, config, 1)

    def _tables(self, images: list[Tensor | Mosaics]) -> list[Seen]:
        """See the distinct cells of each image."""
        heads = (self.attention, self.value, self.form)
        weight = torch.cat([part.weight for part in heads])
        tables = []
        for image, part in zip(images, weight.chunk(self.images, -1), strict=True):
            cells = self.appearance(image)
            colour, form = self.words.evidence(cells)
            silent = F.linear(cells.silhouette, part)
            silent, forms = silent.split([silent.shape[-1] - FORMS, FORMS], -1)
            tables.append(Seen(colour + form + self.threshold, silent, forms, cells.where))
        return tables

    def encode_scenes(self, *pixels: Tensor) -> Kinds:
        """Encode images, each [*B, C, H, W], those of their cells that look alike once."""
        images = [self.flat_pixels(image)[0] for image in pixels]
        tables = self._tables(images)
        forms = sum(look_up(table.forms, table.where) for table in tables) + self.form.bias
        around = F.relu(surroundings(self.around, F.relu(forms), self.grid))
        place = self.place.to(around.dtype).expand(len(around), -1, -1)
        index = tables[0].where
        for table in tables[1:]:
            index = index * len(table.said) + table.where
        kind, number, mean = group_cells(index, torch.cat([place, around], -1))
        cells: list[Tensor] = []
        for table in reversed(tables):
            cells.insert(0, kind % len(table.said))
            kind = kind // len(table.said)
        both = list(zip(tables, cells, strict=True))
        said = [look_up(table.said, own) for table, own in both]
        silent = sum(look_up(table.silent, own) for table, own in both)
        silent = silent + torch.cat([self.attention.bias, self.value.bias])
        features = torch.cat([*said, silent, mean[..., 2:]], -1)
        return Kinds(features.transpose(1, 2), mean[..., :2], number)

    def encode_instruction(self, instruction: Tensor) -> Tensor:
        """Map token ids [*B, L] to how much each word counts, and the modifier: [*B, D]."""
        rows = rows_of_ids(instruction)
        with torch.autocast(rows.device.type, enabled=False):
            if rows.is_cuda:  # which would have to be waited for
                words = self._heard(rows)
            else:
                distinct, which = distinct_rows(rows)
                words = look_up(self._heard(distinct), which)
        return words.reshape(*instruction.shape[:-1], words.shape[-1])

    def _heard(self, tokens: Tensor) -> Tensor:
        """Encode every row of ids [N, L]: [N, D]."""
        spoken, modifier = self.words.listen(without_padding(tokens, self.known))
        return torch.cat([spoken.flatten(1), modifier], -1)

    def _read(self, scenes: Kinds, words: Tensor, index: Tensor) -> Tensor:
        # Cells are the second dimension throughout: on a CPU a softmax over a last dimension of a
        # dozen takes thirty times as long.
        cells, place = scenes.features, scenes.place.to(scenes.features.dtype)
        number = scenes.number.to(cells.dtype)  # [N, C]
        each, prior = number.clamp_min(1), number.log()
        count = index.shape[1]
        logits = self._pointed(cells, words[:, :-MODIFIER], index)
        weighed = (torch.cat([logits, -logits], 3) + prior[..., None, None]).softmax(1)
        known = self.images * self.known
        silent, around = cells[:, known:].split([cells.shape[1] - known - AROUND, AROUND], 1)
        heads = self.attention.out_features
        attention = (silent[:, :heads] + prior[..., None, :]).softmax(-1)  # [N, heads, C]
        seen = torch.cat([attention @ place, attention @ silent[:, heads:].transpose(1, 2)], -1)
        shared = (attention / each[..., None, :]).transpose(1, 2)
        there = torch.cat([shared, place, around.transpose(1, 2)], -1)
        pairs = weighed.flatten(2).transpose(1, 2)  # [N, K * 2 * images * maps, C]
        found = (pairs @ there).unflatten(1, weighed.shape[2:])  # [N, K, 2 * images * maps, ...]
        fit = torch.sigmoid(self.scale * logits + self.bias)
        fits = (fit * number[..., None, None]).sum(1)
        parts = [
            seen.flatten(1).unsqueeze(1).expand(-1, count, -1),
            *(part.flatten(2) for part in found.split([heads, 2, AROUND], -1)),
            (weighed / each[..., None, None]).amax(1),
            fits,
            torch.tanh(fits),
            words[:, -MODIFIER:][index],
        ]
        return torch.cat(parts, -1)

    def _pointed(self, cells: Tensor, spoken: Tensor, index: Tensor) -> Tensor:
        """Return the maps' logits of cells [N, F, C] for instructions: [N, C, K, images * maps].

        ``spoken`` is how much each word counts for each map, [P, V * maps]; ``index`` is [N, K].
        """
        maps = self.config.maps
        weights = spoken.unflatten(1, (self.known, maps)).transpose(1, 2)[index]  # [N, K, maps, V]
        said = cells[:, : self.images * self.known].unflatten(1, (self.images, self.known))
        told = said.transpose(2, 3) @ weights.flatten(1, 2).unsqueeze(1).transpose(2, 3)
        return told.unflatten(3, (index.shape[1], maps)).permute(0, 2, 3, 1, 4).flatten(3)
