"""Which action led from one image to the next (the paper's inverse module)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ifo_grounding.networks.base import ImageNetwork, same_batch
from ifo_grounding.networks.cells import distinct_pairs
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.encoders import ConvEncoder, PatchEncoder
from ifo_grounding.networks.layers import ResidualBlock, flatten_cells, head
from ifo_grounding.networks.patches import Mosaics, as_pixels
from ifo_grounding.networks.shapes import Shapes, patch_size


class InverseNetwork(ImageNetwork):
    """inv(s, s') -> logits of the actions.

    ``paper`` sees the two images alone. ``strong`` also sees how far each pixel changed, which
    makes a stop plain, and pools over cells: what changes tells the action wherever it happens.
    """

    def __init__(self, shapes: Shapes, config: NetworkConfig) -> None:
        super().__init__(shapes, config)
        channels, features = shapes.image_shape[0], config.features
        self.image: ConvEncoder | PatchEncoder
        if config.preset == "paper":
            self.image = ConvEncoder(2 * channels, features, config.conv_layers)
            size = features * math.prod(self.grid)
        else:
            self.image = PatchEncoder(channels, features, patch_size(shapes, config))
            size = 2 * features
        self.blocks = nn.Sequential(*(ResidualBlock(features) for _ in range(config.context)))
        self.head = head(size, config, shapes.n_actions)

    def forward(self, pixels: Tensor, next_pixels: Tensor) -> Tensor:
        """Map two images, each [*B, C, H, W], to float32 logits [*B, A]."""
        before, batch = self.flat_pixels(pixels)
        after, next_batch = self.flat_pixels(next_pixels)
        same_batch(pixels=batch, next_pixels=next_batch)
        if (
            isinstance(before, Mosaics)
            and isinstance(after, Mosaics)
            and not before.tiles.is_cuda  # which would have to be waited for
            and self.reads_tiles(self.shapes.image_shape, before.tiles.shape[-1])
        ):
            outputs = self.from_tiles(before.tiles, before.codes, after.codes)
        else:
            both = torch.cat([as_pixels(before), as_pixels(after)], -3)
            outputs = self._logits(self.image(both))
        return outputs.float().reshape(*batch, outputs.shape[-1])

    def reads_tiles(self, image_shape: tuple[int, ...], tile_size: int | None) -> bool:
        """Whether :meth:`from_tiles` takes images of this shape made of tiles of this size."""
        fits = isinstance(self.image, PatchEncoder) and self.image.patch == tile_size
        return fits and image_shape == self.shapes.image_shape

    def from_tiles(self, tiles: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """Map the pictures that tiles make to logits, float32 [N, A], without making them.

        Args:
            tiles: distinct tiles as large as this network's patches, uint8 [K, C, T, T].
            before: which tile lies where in the images before, integer [N, h, w].
            after: the same of the images after.
        """
        assert isinstance(self.image, PatchEncoder)
        codes = before.flatten(1).long(), after.flatten(1).long()
        first, second, index = distinct_pairs(*codes, len(tiles), len(tiles))
        seen = torch.cat([tiles[first], tiles[second]], 1).flatten(2)
        height, width = before.shape[1:]
        return self._logits(self.image.look_up(seen, index, (height, width))).float()

    def _logits(self, encoded: Tensor) -> Tensor:
        """Map encoded images [N, F, h, w] to logits [N, A]."""
        features = F.relu(self.blocks(F.relu(encoded)))
        if self.config.preset == "paper":
            return self.head(flatten_cells(features))
        return self.head(torch.cat([features.amax((-2, -1)), features.mean((-2, -1))], -1))
