"""Where the instruction meets the image."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class GatedAttention(nn.Module):
    r"""Gate the channels of a feature map by an instruction (the paper's first equation).

    .. math:: \text{GA}(s, t) = \text{CNN}(s) \odot h(\text{GRU}(t))

    where h is a linear layer with a sigmoid, extended over the height and width of the feature map
    (Chaplot et al. 2018).

    >>> gate = GatedAttention(instruction_size=128, features=32)
    >>> gate(torch.ones(2, 32, 3, 3), torch.zeros(2, 128)).shape
    torch.Size([2, 32, 3, 3])
    """

    def __init__(self, instruction_size: int, features: int) -> None:
        super().__init__()
        self.h = nn.Linear(instruction_size, features)

    def forward(self, image: Tensor, instruction: Tensor) -> Tensor:
        """Gate ``image`` [N, F, H, W], i.e. CNN(s), by ``instruction`` [N, D], i.e. GRU(t)."""
        return image * torch.sigmoid(self.h(instruction))[..., None, None]


class ResidualFiLM(nn.Module):
    """Mix channels, scale and shift them by an instruction, ReLU, look at neighbours, add.

    A 1x1 convolution, feature-wise linear modulation (Perez et al. 2018), ReLU and a 3x3
    convolution, added to the input. The size of the feature map stays.

    >>> ResidualFiLM(128, 64)(torch.ones(2, 64, 6, 6), torch.zeros(2, 128)).shape
    torch.Size([2, 64, 6, 6])
    """

    def __init__(self, instruction_size: int, features: int) -> None:
        super().__init__()
        self.mix = nn.Conv2d(features, features, 1)
        self.film = nn.Linear(instruction_size, 2 * features)
        self.look = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, image: Tensor, instruction: Tensor) -> Tensor:
        """Return ``image`` [N, F, H, W] changed as ``instruction`` [N, D] asks."""
        scale, shift = self.film(instruction)[..., None, None].chunk(2, -3)
        modulated = torch.addcmul(shift, self.mix(image), 1 + scale)
        return image + self.look(F.relu(modulated))


class ResidualBlock(nn.Module):
    """A 1x1 convolution, ReLU and a 3x3 convolution, added to the input; no instruction.

    >>> ResidualBlock(64)(torch.ones(2, 64, 6, 6)).shape
    torch.Size([2, 64, 6, 6])
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.mix = nn.Conv2d(features, features, 1)
        self.look = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Return ``image`` [N, F, H, W] with what lies around each cell mixed in."""
        return image + self.look(F.relu(self.mix(image)))


def pool_cells(image: Tensor) -> Tensor:
    """Return the maximum and the mean over cells: [N, F, H, W] -> [N, 2 F].

    >>> pool_cells(torch.tensor([[[[1.0, 3.0]]]])).tolist()
    [[3.0, 2.0]]
    """
    return torch.cat([image.amax((-2, -1)), image.mean((-2, -1))], -1)
