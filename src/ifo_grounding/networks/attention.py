"""Where a policy looks."""

from __future__ import annotations

from torch import Tensor, nn

from ifo_grounding.networks.transfer import instructed_network
from ifo_grounding.networks.trunk import grid


def attention_maps(policy: nn.Module, pixels: Tensor, instruction: Tensor) -> Tensor:
    """Return how each map of a policy weighs the cells of images, in the light of instructions.

    The maps are the word maps of the preset ``strong``, each read both ways, the heads of ``film``,
    and of ``paper`` what all gates together let through.

    Args:
        policy: built by ``make_policy``.
        pixels: uint8 [N, C, H, W].
        instruction: token ids, int64 [N, L].

    Returns:
        Weights, float32 [N, M, h, w], which sum to 1 over the cells of a map.

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
    return maps.unflatten(-1, grid(network.shapes, network.config))
