"""Layers that several networks share."""

from __future__ import annotations

import itertools
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.networks.config import NetworkConfig

GATE_GAIN = 9.0
"""Initial standard deviation of a gate's logit, relative to that of an instruction's features."""


class GatedAttention(nn.Module):
    r"""Gate the channels of a feature map by an instruction (the paper's first equation).

    .. math:: \text{GA}(s, t) = \text{CNN}(s) \odot h(\text{GRU}(t))

    where h is a linear layer with a sigmoid, extended over the height and width of the feature map
    (Chaplot et al. 2018). The initial weights of h are so large that gates differ from one sentence
    to another: with PyTorch's own they differ by a hundredth, and learn from it late.

    Args:
        rate: how fast h learns, relative to the rest of the network: its weights are kept divided
            by it. Gates that learn as fast as all else saturate on what is learned first, such as
            colours, before they tell shapes apart.
    """

    def __init__(self, instruction_size: int, features: int, rate: float = 1.0) -> None:
        super().__init__()
        self.rate = rate
        self.h = nn.Linear(instruction_size, features)
        nn.init.normal_(self.h.weight, std=GATE_GAIN / math.sqrt(instruction_size) / rate)
        nn.init.zeros_(self.h.bias)

    def gates(self, instruction: Tensor) -> Tensor:
        """Map encoded instructions [N, D] to the gate of each channel, [N, F]."""
        return torch.sigmoid(self.rate * self.h(instruction))

    def forward(self, image: Tensor, instruction: Tensor) -> Tensor:
        """Gate ``image`` [N, F, H, W], i.e. CNN(s), by ``instruction`` [N, D], i.e. GRU(t)."""
        return image * self.gates(instruction)[..., None, None]


class ResidualBlock(nn.Module):
    """A linear layer per cell, ReLU, and a convolution of kernel 3, added to the input."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.mix = nn.Linear(features, features)
        self.look = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Return ``image`` [N, F, H, W] with what lies around each cell mixed in."""
        # What a 1x1 convolution computes, faster on a CPU where channels lie last in memory.
        mixed = self.mix(image.movedim(-3, -1)).movedim(-1, -3)
        return image + self.look(F.relu(mixed))


def flatten_cells(features: Tensor) -> Tensor:
    """Flatten [N, F, h, w] to [N, h * w * F], the order in which it lies in memory."""
    return features.permute(0, 2, 3, 1).flatten(1)


def convolutions(*sizes: int, stride: int = 1) -> nn.Sequential:
    """Return convolutions of kernel 3 and padding 1 from size to size, and a ReLU after each."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Conv2d(before, after, 3, stride, padding=1), nn.ReLU()]
    return nn.Sequential(*layers)


def init_before_relu(layer: nn.Conv2d | nn.Linear) -> None:
    """Draw the initial weights of a layer that a ReLU follows (He et al. 2015), and no bias."""
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)


def head(size: int, config: NetworkConfig, outputs: int) -> nn.Sequential:
    """Return several linear layers with ReLU between them and dropout before each."""
    layers: list[nn.Module] = []
    for hidden in config.head_hidden:
        layer = nn.Linear(size, hidden)
        if config.preset == "paper":
            init_before_relu(layer)
        layers += [nn.Dropout(config.dropout), layer, nn.ReLU()]
        size = hidden
    return nn.Sequential(*layers, nn.Dropout(config.dropout), nn.Linear(size, outputs))
