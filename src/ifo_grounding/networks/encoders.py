"""From pixels to features: what repeats in a batch of images is seen once."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.networks.cells import look_up
from ifo_grounding.networks.layers import init_before_relu
from ifo_grounding.networks.patches import (
    Windows,
    as_float,
    distinct_patches,
    distinct_views,
    patches,
)


class ConvEncoder(nn.Module):
    """Convolutions of kernel 3, stride 2, padding 1 with ReLU (the paper's experimental settings).

    Initial weights are He's: PyTorch's own, which are smaller, would leave a fiftieth of an image's
    contrast after four layers. Where what a layer looks at repeats, over a batch of images, the
    layer sees it once.

    >>> ConvEncoder(3, features=32, layers=4)(torch.zeros(2, 3, 48, 48)).shape
    torch.Size([2, 32, 3, 3])
    """

    def __init__(self, channels: int, features: int, layers: int) -> None:
        super().__init__()
        sizes = [channels] + [features] * layers
        self.layers = nn.Sequential(
            *(
                part
                for before, after in itertools.pairwise(sizes)
                for part in (nn.Conv2d(before, after, 3, stride=2, padding=1), nn.ReLU())
            )
        )
        for layer in self.convolutions:
            init_before_relu(layer)

    @property
    def convolutions(self) -> list[nn.Conv2d]:
        """The layers, without what follows each."""
        return [part for part in self.layers if isinstance(part, nn.Conv2d)]

    def forward(self, image: Tensor) -> Tensor:
        """Map an image [N, C, H, W] to features [N, F, h, w]."""
        first, *others = self.convolutions
        views = distinct_views(image, 1 + len(others)) if others else None
        if views is None:
            return self.layers(as_float(image, first.weight))
        features = _two_layers(first, others[0], views.windows)
        for layer, blocks in zip(others[1:], views.blocks, strict=False):
            seen = look_up(F.pad(features, (0, 0, 1, 0)), blocks)  # zeros beyond the edges
            features = _on_blocks(layer, seen)
        rest = self.layers[2 * (2 + len(views.blocks)) :]
        return rest(look_up(features, views.where).movedim(-1, 1))

    @staticmethod
    def grid(height: int, width: int, layers: int) -> tuple[int, int]:
        """Return the size of the feature map of an image."""
        for _ in range(layers):
            height, width = (height + 1) // 2, (width + 1) // 2
        return height, width


def _two_layers(first: nn.Conv2d, second: nn.Conv2d, windows: Windows) -> Tensor:
    """Map windows to what two convolutions of kernel 3 and stride 2 make of each, [U, F]."""
    seen = as_float(windows.pixels, first.weight).contiguous(memory_format=torch.channels_last)
    features = F.relu(F.conv2d(seen, first.weight, first.bias, stride=2)).permute(0, 2, 3, 1)
    inside = features.new_ones(len(features), 3, 3, 1)
    inside[windows.top, 0] = 0  # the second layer sees zeros beyond the edges
    inside[windows.side, :, 0] = 0
    return _on_blocks(second, features * inside)


def _on_blocks(layer: nn.Conv2d, seen: Tensor) -> Tensor:
    """Apply a convolution of kernel 3 and a ReLU to what it sees at some places, [U, 3, 3, F]."""
    weight = layer.weight.permute(0, 2, 3, 1).flatten(1)
    return F.relu(F.linear(seen.flatten(1), weight, layer.bias))


class PatchEncoder(nn.Module):
    """One feature vector per patch, the same wherever the patch lies.

    A linear layer of rearranged pixels, which trains faster on a CPU than a strided convolution:
    bytes are cheaper to rearrange than floats, and the layout fits the convolutions that follow.
    An image whose sides are not multiples of the patch is padded with black to the right and below.
    Where patches of bytes repeat, each distinct one is embedded once.

    Args:
        channels: what :attr:`complete` makes of an image's channels.
        features: F.
        patch: pixels along one side of a patch.
        complete: makes what is embedded of images or distinct patches, [N, C, ...]; by default they
            are embedded as they are.

    >>> PatchEncoder(3, features=64, patch=8)(torch.zeros(2, 3, 48, 48)).shape
    torch.Size([2, 64, 6, 6])
    """

    def __init__(
        self,
        channels: int,
        features: int,
        patch: int,
        complete: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.patch, self.complete = patch, complete or nn.Identity()
        self.embed = nn.Linear(channels * patch**2, features)

    def forward(self, image: Tensor) -> Tensor:
        """Map an image [N, C, H, W] to features [N, F, h, w], channels last in memory."""
        found = distinct_patches(image, self.patch)
        if found is not None:
            height, width = image.shape[-2:]
            return self.look_up(*found, self.grid(height, width, self.patch))
        cut = as_float(patches(self.complete(image), self.patch), self.embed.weight)
        return self.embed(cut).permute(0, 3, 1, 2)

    def look_up(self, distinct: Tensor, index: Tensor, grid: tuple[int, int]) -> Tensor:
        """Embed distinct patches [U, C, P * P] once, and look them up: [N, F, h, w].

        Args:
            distinct: of bytes.
            index: which of them lies where, int64 [N, h * w].
            grid: h and w.
        """
        pixels = as_float(self.complete(distinct).flatten(1), self.embed.weight)
        return look_up(self.embed(pixels), index).unflatten(1, grid).movedim(-1, 1)

    @staticmethod
    def grid(height: int, width: int, patch: int) -> tuple[int, int]:
        """Return the number of patches down and across an image."""
        return -(-height // patch), -(-width // patch)
