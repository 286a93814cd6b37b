"""What policy, critic and reward model are made of."""

from __future__ import annotations

import math

import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.networks.base import ImageNetwork, same_batch
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.encoders import ConvEncoder
from ifo_grounding.networks.grounding import GroundedTrunk
from ifo_grounding.networks.layers import GatedAttention, flatten_cells, head
from ifo_grounding.networks.sentences import GRUInstructionEncoder
from ifo_grounding.networks.shapes import Shapes


class GatedTrunk(nn.Module):
    """Features of an image whose channels an instruction gates (the paper's)."""

    def __init__(self, shapes: Shapes, config: NetworkConfig, images: int = 1) -> None:
        super().__init__()
        channels, height, width = shapes.image_shape
        self.image = ConvEncoder(images * channels, config.features, config.conv_layers)
        self.instruction = GRUInstructionEncoder(
            shapes.vocabulary_size,
            config.embedding,
            config.hidden,
            config.sentence_rate,
            config.sentence_pooling,
        )
        self.fusion = GatedAttention(self.instruction.size, config.features, config.sentence_rate)
        self.size = config.features * math.prod(ConvEncoder.grid(height, width, config.conv_layers))

    def fuse(self, image: Tensor, tokens: Tensor) -> Tensor:
        """Map an image [N, C, H, W] and token ids [N, L] to fused features [N, F, h, w]."""
        return F.relu(self.fusion(self.image(image), self.instruction(tokens)))

    def maps(self, image: Tensor, tokens: Tensor) -> Tensor:
        """Return what all gates together let through of each cell of an image: [N, 1, h * w]."""
        let_through = self.fuse(image, tokens).sum(1, keepdim=True).flatten(2)
        return let_through / let_through.sum(-1, keepdim=True).clamp_min(1e-9)

    def forward(self, image: Tensor, tokens: Tensor) -> Tensor:
        """Map an image [N, C, H, W] and token ids [N, L] to [N, size]."""
        return flatten_cells(self.fuse(image, tokens))


class InstructedNetwork(ImageNetwork):
    """The preset's trunk and a head: policy, critic, and what the reward model is made of.

    Args:
        shapes: sizes of inputs.
        config: sizes of the network.
        outputs: how many; by default a logit for each action.
    """

    def __init__(self, shapes: Shapes, config: NetworkConfig, outputs: int | None = None) -> None:
        super().__init__(shapes, config)
        kind = GatedTrunk if config.preset == "paper" else GroundedTrunk
        self.trunk: GatedTrunk | GroundedTrunk = kind(shapes, config)
        self.head = head(self.trunk.size, config, outputs or shapes.n_actions)

    def forward(self, pixels: Tensor, instruction: Tensor) -> Tensor:
        """Map pixels [*B, C, H, W] and token ids [*B, L] to float32 [*B, outputs]."""
        image, batch = self.flat_pixels(pixels)
        same_batch(pixels=batch, instruction=instruction.shape[:-1])
        with self.autocast(pixels):
            outputs = self.head(self.trunk(image, instruction.reshape(-1, instruction.shape[-1])))
        return outputs.float().reshape(*batch, outputs.shape[-1])
