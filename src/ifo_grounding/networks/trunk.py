"""Policy, critic and reward model: the preset's trunk, which reads image and words, and a head."""

from __future__ import annotations

import math

import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.errors import UserError
from ifo_grounding.networks.base import ImageNetwork, same_batch
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.encoders import ConvEncoder
from ifo_grounding.networks.grounding import GroundedTrunk
from ifo_grounding.networks.layers import GatedAttention, flatten_cells, head
from ifo_grounding.networks.patches import Mosaics, as_pixels
from ifo_grounding.networks.sentences import GRUInstructionEncoder
from ifo_grounding.networks.shapes import Shapes, grid_of


class GatedTrunk(nn.Module):
    """Features of an image whose channels an instruction gates (the paper's)."""

    def __init__(self, shapes: Shapes, config: NetworkConfig, images: int = 1) -> None:
        super().__init__()
        channels = images * shapes.image_shape[0]
        self.image = ConvEncoder(channels, config.features, config.conv_layers)
        self.instruction = GRUInstructionEncoder(
            shapes.vocabulary_size,
            config.embedding,
            config.hidden,
            config.sentence_rate,
            config.sentence_pooling,
        )
        self.fusion = GatedAttention(self.instruction.size, config.features, config.sentence_rate)
        self.size = config.features * math.prod(grid_of(shapes, config))

    def fuse(self, image: Tensor | Mosaics, tokens: Tensor) -> Tensor:
        """Map an image [N, C, H, W] and token ids [N, L] to fused features [N, F, h, w]."""
        return F.relu(self.fusion(self.image(as_pixels(image)), self.instruction(tokens)))

    def maps(self, image: Tensor | Mosaics, tokens: Tensor) -> Tensor:
        """Return what all gates together let through of each cell of an image: [N, 1, h * w]."""
        let_through = self.fuse(image, tokens).sum(1, keepdim=True).flatten(2)
        return let_through / let_through.sum(-1, keepdim=True).clamp_min(1e-9)

    def forward(self, image: Tensor | Mosaics, tokens: Tensor) -> Tensor:
        """Map an image [N, C, H, W] and token ids [N, L] to [N, size]."""
        return flatten_cells(self.fuse(image, tokens))


class InstructedNetwork(ImageNetwork):
    """The preset's trunk and a head: policy, and critic with ``outputs=1``."""

    def __init__(self, shapes: Shapes, config: NetworkConfig, outputs: int | None = None) -> None:
        super().__init__(shapes, config)
        kind = GatedTrunk if config.preset == "paper" else GroundedTrunk
        self.trunk: GatedTrunk | GroundedTrunk = kind(shapes, config)
        self.head = head(self.trunk.size, config, outputs or shapes.n_actions)

    def forward(self, pixels: Tensor, instruction: Tensor) -> Tensor:
        """Map pixels [*B, C, H, W] and token ids [*B, L] to float32 [*B, outputs]."""
        image, batch = self.flat_pixels(pixels)
        same_batch(pixels=batch, instruction=instruction.shape[:-1])
        outputs = self.head(self.trunk(image, instruction.reshape(-1, instruction.shape[-1])))
        return outputs.float().reshape(*batch, outputs.shape[-1])


class RewardNetwork(InstructedNetwork):
    """rwd(s, t, a): one logit per action, of which the action at hand is read."""

    def all_actions(self, pixels: Tensor, instruction: Tensor) -> Tensor:
        """Score every action: logits, float32 [*B, A]."""
        return super().forward(pixels, instruction)

    def forward(self, pixels: Tensor, instruction: Tensor, action: Tensor) -> Tensor:  # type: ignore[override]
        """Score the action, integer [*B], for the image and instruction: logits [*B, 1]."""
        scores = self.all_actions(pixels, instruction)
        same_batch(pixels=scores.shape[:-1], action=action.shape)
        return scores.gather(-1, action.long().unsqueeze(-1))


def instructed_network(policy: nn.Module) -> InstructedNetwork:
    """Return the network within a policy that ``make_policy`` built."""
    found = [part for part in policy.modules() if isinstance(part, InstructedNetwork)]
    if len(found) != 1:
        raise UserError("this must be a policy built by make_policy")
    return found[0]


def attention_maps(policy: nn.Module, pixels: Tensor, instruction: Tensor) -> Tensor:
    """Return how each map of a policy weighs the cells of images: float32 [N, M, h, w], sums are 1.

    The maps are the word maps of the preset ``strong``, each read as evidence for places and as
    evidence against them, and of ``paper`` what all gates together let through.

    Args:
        pixels: uint8 [N, C, H, W].
        instruction: token ids, int64 [N, L].

    >>> import torch
    >>> from ifo_grounding.networks import Shapes, make_policy
    >>> policy = make_policy(Shapes(image_shape=(3, 48, 48), vocabulary_size=40), seed=0)
    >>> words = torch.ones(2, 16, dtype=torch.int64)
    >>> attention_maps(policy, torch.zeros(2, 3, 48, 48), words).shape
    torch.Size([2, 16, 6, 6])
    """
    network = instructed_network(policy)
    image, _ = network.flat_pixels(pixels)
    maps = network.trunk.maps(image, instruction).float()
    return maps.unflatten(-1, network.grid)
