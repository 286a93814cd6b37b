"""Where the instruction meets the image."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

GATE_GAIN = 9.0
"""Standard deviation of a gate's logit to begin with, by that of an instruction's features."""


class GatedAttention(nn.Module):
    r"""Gate the channels of a feature map by an instruction (the paper's first equation).

    .. math:: \text{GA}(s, t) = \text{CNN}(s) \odot h(\text{GRU}(t))

    where h is a linear layer with a sigmoid, extended over the height and width of the feature map
    (Chaplot et al. 2018). Weights of h begin so large that gates differ from one sentence to
    another: with PyTorch's own they differ by a hundredth, and learn from it late.

    Args:
        instruction_size: D, the size of an encoded instruction.
        features: F, the channels of the feature map.
        rate: how fast h learns, by the rest of the network: its weights are kept divided by it.
            What is learned first, such as colours, drives gates that learn as fast as all else to
            where a sigmoid hardly learns any more, and sentences that differ in what is to be
            learned later, such as shapes, share their gates by then.

    >>> gate = GatedAttention(instruction_size=128, features=32)
    >>> gate(torch.ones(2, 32, 3, 3), torch.zeros(2, 128)).shape
    torch.Size([2, 32, 3, 3])
    """

    def __init__(self, instruction_size: int, features: int, rate: float = 1.0) -> None:
        super().__init__()
        self.rate = rate
        self.h = nn.Linear(instruction_size, features)
        nn.init.normal_(self.h.weight, std=GATE_GAIN / math.sqrt(instruction_size) / rate)
        nn.init.zeros_(self.h.bias)

    def forward(self, image: Tensor, instruction: Tensor) -> Tensor:
        """Gate ``image`` [N, F, H, W], i.e. CNN(s), by ``instruction`` [N, D], i.e. GRU(t)."""
        return image * torch.sigmoid(self.rate * self.h(instruction))[..., None, None]


class ResidualFiLM(nn.Module):
    """Mix channels, scale and shift them by an instruction, ReLU, mix again, add.

    A linear layer per cell, feature-wise linear modulation (Perez et al. 2018), ReLU and a second
    layer, added to the input. The size of the feature map stays.

    With ``kernel=1`` no cell sees another: what a cell holds is then learned once for all places,
    and a policy needs far fewer demonstrations. With 3, the second layer is a convolution.

    >>> ResidualFiLM(128, 64)(torch.ones(2, 64, 6, 6), torch.zeros(2, 128)).shape
    torch.Size([2, 64, 6, 6])
    """

    def __init__(self, instruction_size: int, features: int, kernel: int = 1) -> None:
        super().__init__()
        self.mix = CellLinear(features, features)
        self.film = nn.Linear(instruction_size, 2 * features)
        self.look = _look(features, kernel)

    def forward(self, image: Tensor, instruction: Tensor) -> Tensor:
        """Return ``image`` [N, F, H, W] changed as ``instruction`` [N, D] asks."""
        return self.modulate(image, self.film(instruction))

    def modulate(self, image: Tensor, film: Tensor) -> Tensor:
        """Return ``image`` [N, F, H, W] scaled and shifted between its layers by [N, 2 F]."""
        scale, shift = film[..., None, None].chunk(2, -3)
        return image + self.look(F.relu(torch.addcmul(shift, self.mix(image), 1 + scale)))


class ResidualBlock(nn.Module):
    """Two layers with a ReLU between, added to the input; no instruction.

    >>> ResidualBlock(64)(torch.ones(2, 64, 6, 6)).shape
    torch.Size([2, 64, 6, 6])
    """

    def __init__(self, features: int, kernel: int = 3) -> None:
        super().__init__()
        self.mix = CellLinear(features, features)
        self.look = _look(features, kernel)

    def forward(self, image: Tensor) -> Tensor:
        """Return ``image`` [N, F, H, W] with what lies around each cell mixed in."""
        return image + self.look(F.relu(self.mix(image)))


class CellLinear(nn.Linear):
    """A linear layer over the channels of every cell: [N, F, H, W] -> [N, G, H, W].

    What a 1x1 convolution computes, faster on a CPU where channels lie last in memory.

    >>> CellLinear(3, 5)(torch.ones(2, 3, 6, 6)).shape
    torch.Size([2, 5, 6, 6])
    """

    def forward(self, image: Tensor) -> Tensor:
        """Map ``image`` [N, F, H, W]."""
        return super().forward(image.movedim(-3, -1)).movedim(-1, -3)


def _look(features: int, kernel: int) -> nn.Module:
    if kernel == 1:
        return CellLinear(features, features)
    return nn.Conv2d(features, features, kernel, padding=kernel // 2)


def cell_places(grid: tuple[int, int]) -> Tensor:
    """Return the row and column of each cell in [-1, 1], [h * w, 2]; 0 along a side of one cell.

    >>> cell_places((1, 2)).tolist()
    [[0.0, -1.0], [0.0, 1.0]]
    """
    axes = [torch.linspace(-1, 1, length) if length > 1 else torch.zeros(1) for length in grid]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).flatten(0, 1)


class SpatialReadout(nn.Module):
    """Where several attention maps look, and what they see there.

    Each head weighs the cells by a softmax, and reads the expected row and column in [-1, 1]
    (spatial soft arg-max, Levine et al. 2016) and the expected values of a linear layer. A head
    that follows it thinks in places rather than in cells: it cannot learn one map by heart.

    >>> readout = SpatialReadout(64, heads=8, values=16, grid=(6, 6))
    >>> readout(torch.ones(2, 64, 6, 6)).shape, readout.size
    (torch.Size([2, 144]), 144)
    """

    place: Tensor

    def __init__(self, features: int, heads: int, values: int, grid: tuple[int, int]) -> None:
        super().__init__()
        self.attention = CellLinear(features, heads)
        self.value = CellLinear(features, values)
        self.size = heads * (2 + values)
        # Maps that are sharp and unlike each other from the start learn many times sooner where
        # to look: flat ones all read the same mean, which tells nothing.
        nn.init.normal_(self.attention.weight, std=8 / math.sqrt(features))
        self.register_buffer("place", cell_places(grid), persistent=False)

    def maps(self, image: Tensor) -> Tensor:
        """Return how each head weighs the cells of ``image`` [N, F, H, W]: [N, heads, H, W]."""
        logits = self.attention(image)
        return logits.flatten(-2).softmax(-1).unflatten(-1, logits.shape[-2:])

    def forward(self, image: Tensor) -> Tensor:
        """Read ``image`` [N, F, H, W]: [N, heads * (2 + values)]."""
        logits, seen = (part.movedim(-3, -1).flatten(-3, -2) for part in self.outlook(image))
        return self.read(logits, seen, self.place)

    def outlook(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits [N, heads, H, W] and values [N, values, H, W] of [N, F, H, W]."""
        return self.attention(image), self.value(image)

    def read(
        self, logits: Tensor, seen: Tensor, place: Tensor, number: Tensor | None = None
    ) -> Tensor:
        """Read cells, or groups of cells that look alike.

        Args:
            logits: how much each head is drawn to a cell, [N, C, heads].
            seen: values [N, C, values].
            place: of a cell, or the mean of a group, [C, 2] or [N, C, 2].
            number: of the cells of a group, [N, C]; None means one each.
        """
        if number is not None:
            logits = logits + number.log().unsqueeze(-1).to(logits.dtype)
        # A softmax, written out: over a dim that is not the last one it takes twice as long.
        weights = (logits - logits.detach().amax(-2, keepdim=True)).exp()
        weights = (weights / weights.sum(-2, keepdim=True)).transpose(-1, -2)
        place = place.to(seen.dtype).expand(*seen.shape[:-1], 2)
        return (weights @ torch.cat([place, seen], -1)).flatten(-2)


class CellCount(nn.Module):
    """How many cells each of several detectors finds: a number, and whether there is any.

    A detector is a linear layer and a sigmoid in every cell. The sum over cells tells one from
    two, which a mean hardly does, and so lets a classifier see that a description is ambiguous.

    >>> count = CellCount(64, detectors=16)
    >>> count(torch.ones(2, 64, 6, 6)).shape, count.size
    (torch.Size([2, 32]), 32)
    """

    def __init__(self, features: int, detectors: int) -> None:
        super().__init__()
        self.detect = CellLinear(features, detectors)
        nn.init.constant_(self.detect.bias, -4.0)  # most cells hold nothing of interest
        self.size = 2 * detectors

    def forward(self, image: Tensor) -> Tensor:
        """Count in ``image`` [N, F, H, W]: [N, 2 * detectors]."""
        return self.read(self.outlook(image).movedim(-3, -1).flatten(-3, -2))

    def outlook(self, image: Tensor) -> Tensor:
        """Return what each cell of [N, F, H, W] counts for: [N, detectors, H, W]."""
        return torch.sigmoid(self.detect(image))

    def read(self, outlook: Tensor, number: Tensor | None = None) -> Tensor:
        """Count over cells [N, C, detectors], or over groups of ``number`` [N, C] cells each."""
        if number is None:
            count = outlook.sum(-2)
        else:
            count = (number.unsqueeze(-1).to(outlook.dtype) * outlook).sum(-2)
        return torch.cat([count, torch.tanh(count)], -1)


def pool_cells(image: Tensor) -> Tensor:
    """Return the maximum and the mean over cells: [N, F, H, W] -> [N, 2 F].

    >>> pool_cells(torch.tensor([[[[1.0, 3.0]]]])).tolist()
    [[3.0, 2.0]]
    """
    return torch.cat([image.amax((-2, -1)), image.mean((-2, -1))], -1)
