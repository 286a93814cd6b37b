"""What cells look like: their colours and their form, apart from one another."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.networks.patches import Mosaics, as_float, cells_of

EVIDENCE = 16
"""Size of what a word is compared with."""
CONTRAST = 8.0
"""How sharply an edge is seen: neighbours that differ by 0.1 of the range of a pixel count 0.7."""


class Appearance(NamedTuple):
    """What distinct cells look like."""

    colour: Tensor
    """Which colours are there, wherever, [U, EVIDENCE]."""
    form: Tensor
    """Which form is there, whatever its colour, [U, EVIDENCE]."""
    silhouette: Tensor
    """The form once more, for what hears no words, [U, features]."""
    where: Tensor
    """Which of them lies in each cell, int64 [N, h * w]."""


class ColourAndForm(nn.Module):
    """Sees the colours of a cell and its form apart from one another.

    Colours are what a small network finds at any pixel, form is where neighbouring pixels differ.
    The first cannot tell a circle from a square, the second red from blue.
    """

    def __init__(self, channels: int, features: int, patch: int) -> None:
        super().__init__()
        self.patch = patch
        half = features // 2
        self.pixel = nn.Sequential(
            nn.Linear(channels, half), nn.ReLU(), nn.Linear(half, half), nn.ReLU()
        )
        self.colour = nn.Linear(half, EVIDENCE)
        edges = 2 * patch * (patch - 1)
        self.outline = nn.Linear(edges, features)
        self.form = nn.Linear(features, EVIDENCE)
        self.silhouette = nn.Linear(edges, features)

    def forward(self, image: Tensor | Mosaics) -> Appearance:
        """See images [N, C, H, W], their distinct cells once."""
        tiles, where = cells_of(image, self.patch)
        tiles = as_float(tiles, self.colour.weight)
        pixels = tiles.transpose(1, 2)  # [U, P * P, C]
        colour = self.colour(self.pixel(pixels).amax(1))
        edges = self.edges(tiles)
        form = self.form(F.relu(self.outline(edges)))
        colour, form = (F.layer_norm(seen, (EVIDENCE,)) for seen in (colour, form))
        return Appearance(colour, form, F.relu(self.silhouette(edges)), where)

    def edges(self, tiles: Tensor) -> Tensor:
        """Say where pixels differ from the next one, whatever their colours: [U, 2 P (P - 1)]."""
        square = tiles.unflatten(-1, (self.patch, self.patch))
        across = square.diff(dim=-1).abs().amax(1).flatten(1)
        down = square.diff(dim=-2).abs().amax(1).flatten(1)
        return torch.tanh(CONTRAST * torch.cat([across, down], 1))
