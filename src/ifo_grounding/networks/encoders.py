"""From pixels to features: what repeats in a batch of images is seen once."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.networks.cells import look_up
from ifo_grounding.networks.layers import convolutions, init_before_relu
from ifo_grounding.networks.patches import Windows, as_float, cells_of, distinct_views


class ConvEncoder(nn.Module):
    """Convolutions of kernel 3, stride 2, padding 1 with ReLU (the paper's experimental settings).

    Initial weights are He's: PyTorch's own, which are smaller, would leave a fiftieth of an image's
    contrast after four layers. Where what a layer looks at repeats, over a batch of images, the
    layer sees it once.
    """

    def __init__(self, channels: int, features: int, layers: int) -> None:
        super().__init__()
        self.layers = convolutions(channels, *[features] * layers, stride=2)
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
    """One feature vector per patch of two images and of how far each pixel changed between them.

    It is the same wherever the patch lies: a strided convolution, as a linear layer of distinct
    patches. Bytes are cheaper to rearrange than floats, and the layout fits the convolutions that
    follow.

    Args:
        channels: those of one image.
        patch: pixels along one side of a patch.
    """

    def __init__(self, channels: int, features: int, patch: int) -> None:
        super().__init__()
        self.patch = patch
        self.embed = nn.Linear(3 * channels * patch**2, features)

    def forward(self, both: Tensor) -> Tensor:
        """Map two images [N, 2 C, H, W] to features [N, F, h, w], channels last in memory."""
        grid = -(-both.shape[-2] // self.patch), -(-both.shape[-1] // self.patch)
        return self.look_up(*cells_of(both, self.patch), grid)

    def look_up(self, patches: Tensor, index: Tensor, grid: tuple[int, int]) -> Tensor:
        """Embed distinct patches [U, 2 C, P * P], and look up which lies where: [N, F, h, w].

        ``index`` is int64 [N, h * w], ``grid`` h and w.
        """
        before, after = patches.chunk(2, 1)
        change = torch.maximum(before, after) - torch.minimum(before, after)
        pixels = as_float(torch.cat([patches, change], 1).flatten(1), self.embed.weight)
        return look_up(self.embed(pixels), index).unflatten(1, grid).movedim(-1, 1)
