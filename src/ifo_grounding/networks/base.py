"""What all networks share: flattening batches, and checking shapes."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ifo_grounding.errors import UserError
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.shapes import Shapes, grid_of


class ImageNetwork(nn.Module):
    """Base of the networks: takes any leading batch dims, and checks shapes."""

    def __init__(self, shapes: Shapes, config: NetworkConfig) -> None:
        super().__init__()
        self.shapes = shapes
        self.config = config
        self.grid = grid_of(shapes, config)

    def flat_pixels(self, pixels: Tensor) -> tuple[Tensor, torch.Size]:
        """Return pixels [*B, C, H, W] as [N, C, H, W], and B.

        Raises:
            UserError: for an image of another size than this network was built for, and inside
                ``torch.vmap``.
        """
        if tuple(pixels.shape[-3:]) != self.shapes.image_shape:
            raise UserError(
                f"this network was built for images of {self.shapes.image_shape}, got "
                f"{tuple(pixels.shape[-3:])}: build another for this env or dataset"
            )
        if torch._C._functorch.is_batchedtensor(pixels):
            raise UserError(
                "this network computes what repeats in a batch once, which torch.vmap cannot "
                "follow: give TorchRL's value estimators deactivate_vmap=True"
            )
        return pixels.reshape(-1, *pixels.shape[-3:]), pixels.shape[:-3]


def same_batch(**batches: torch.Size) -> None:
    """Raise :class:`UserError` unless all inputs have the same leading dims."""
    if len(set(batches.values())) > 1:
        listed = ", ".join(f"{name} {list(batch)}" for name, batch in batches.items())
        raise UserError(f"inputs must have the same batch dims, got {listed}: expand them first")
