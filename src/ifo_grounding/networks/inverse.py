"""Which action led from one image to the next (the paper's inverse module)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ifo_grounding import keys
from ifo_grounding.networks.building import blueprint, check_keys, construct, wrap
from ifo_grounding.networks.cells import Cells, distinct_pairs
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.encoders import PatchEncoder
from ifo_grounding.networks.fusion import ResidualBlock, pool_cells
from ifo_grounding.networks.patches import as_float
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.trunk import (
    Network,
    flatten_cells,
    grid,
    head,
    image_encoder,
    same_batch,
)


class InverseNetwork(Network):
    """inv(s, s') -> logits of the actions.

    ``paper`` sees the two images alone. Other presets also see how far each pixel changed, which
    makes a stop plain, and pool over cells: what changes tells the action wherever it happens.
    """

    def __init__(self, shapes: Shapes, config: NetworkConfig) -> None:
        super().__init__(shapes, config)
        self.paper = config.preset == "paper"
        self.image = image_encoder(shapes, config, images=2 if self.paper else 3)
        self.blocks = nn.Sequential(
            *(ResidualBlock(config.features) for _ in range(config.context))
        )
        size = config.features * (math.prod(grid(shapes, config)) if self.paper else 2)
        self.head = head(size, config, shapes.n_actions)

    def forward(self, pixels: Tensor, next_pixels: Tensor) -> Tensor:
        """Map two images, each [*B, C, H, W], to float32 logits [*B, A]."""
        before, batch = self.flat_pixels(pixels)
        after, next_batch = self.flat_pixels(next_pixels)
        same_batch(pixels=batch, next_pixels=next_batch)
        with self.autocast(pixels):
            outputs = self._judged(self._encoded(torch.cat([before, after], -3)))
        return outputs.float().reshape(*batch, outputs.shape[-1])

    def reads_tiles(self, image_shape: tuple[int, ...], tile_size: int | None) -> bool:
        """Whether :meth:`from_tiles` takes images of this shape made of tiles of this size."""
        if not isinstance(self.image, PatchEncoder) or image_shape != self.shapes.image_shape:
            return False
        return self.image.patch == tile_size

    def from_tiles(self, tiles: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """Compute what :meth:`forward` does of the pictures that tiles make, without making them.

        Args:
            tiles: distinct tiles as large as this network's patches, uint8 [K, C, T, T].
            before: which tile lies where in the images before, integer [N, h, w].
            after: the same of the images after.

        Returns:
            Logits, float32 [N, A].
        """
        assert isinstance(self.image, PatchEncoder)
        height, width = before.shape[1:]
        codes = before.flatten(1).long(), after.flatten(1).long()
        first, second, index = distinct_pairs(*codes, len(tiles), len(tiles))
        seen = torch.cat([tiles[first], tiles[second]], 1).flatten(2)
        with self.autocast(tiles):
            pixels = as_float(_with_change(seen).flatten(1), self.image.embed.weight)
            features = self.image.embed(pixels)
            outputs = self._judged(Cells(features, index).maps(height, width))
        return outputs.float()

    def _judged(self, encoded: Tensor) -> Tensor:
        """Map encoded images [N, F, h, w] to logits [N, A]."""
        features = F.relu(self.blocks(F.relu(encoded)))
        return self.head(flatten_cells(features) if self.paper else pool_cells(features))

    def _encoded(self, both: Tensor) -> Tensor:
        """Encode two images on top of each other, [N, 2 C, H, W], to [N, F, h, w]."""
        if self.paper:
            return self.image(both)
        assert isinstance(self.image, PatchEncoder)
        cells = self.image.cells(both, _with_change)
        if cells is None:
            return self.image(_with_change(both))
        return cells.maps(*grid(self.shapes, self.config))


def _with_change(both: Tensor) -> Tensor:
    """Lay on top of two images [N, 2 C, ...] how far each pixel changed: [N, 3 C, ...]."""
    before, after = both.chunk(2, 1)
    return torch.cat([both, torch.maximum(before, after) - torch.minimum(before, after)], 1)


def make_inverse(
    spec_source: Any,
    preset: str = "strong",
    *,
    in_keys: Sequence[NestedKey] = (keys.PIXELS, (keys.NEXT, keys.PIXELS)),
    out_key: NestedKey = keys.LOGITS,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> TensorDictModule:
    """Build the inverse module: two images to logits of the actions, float32 [*B, A].

    Args:
        spec_source: an env, a dataset or a :class:`~ifo_grounding.networks.Shapes`.
        preset: ``"strong"``, ``"film"`` or ``"paper"``.
        in_keys: the image before and the image after, uint8 [*B, C, H, W].
        out_key: where the logits go.
        device: where to build it.
        seed: makes the initial weights a function of the seed alone.
        overrides: values of :class:`~ifo_grounding.networks.NetworkConfig` to replace.

    Raises:
        UserError: for an unknown preset or option, or sizes that cannot be read.

    >>> inverse = make_inverse(Shapes(image_shape=(3, 48, 48), vocabulary_size=40), seed=0)
    >>> frame = torch.zeros(2, 3, 48, 48, dtype=torch.uint8)
    >>> inverse(pixels=frame, next_pixels=frame).shape
    torch.Size([2, 6])
    """
    check_keys(in_keys, ("image", "next image"))
    options = {"in_keys": list(in_keys), "out_key": out_key}
    plan = blueprint("inverse", spec_source, preset, options, overrides)
    return wrap(construct(InverseNetwork, plan, device, seed), plan, in_keys, [out_key])
