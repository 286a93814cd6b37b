"""What all networks share: flattening batches, and checking shapes."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ifo_grounding.errors import UserError, check_below
from ifo_grounding.mosaic import check_tiles
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.patches import Mosaics
from ifo_grounding.networks.shapes import Shapes, grid_of

CODES = torch.int16
"""Type of the numbers of tiles, in place of pixels, which are uint8 or floats."""


class ImageNetwork(nn.Module):
    """Base of the networks: takes any leading batch dims, and checks shapes."""

    tiles: Tensor | None
    """What the numbers of tiles stand for that may come in place of pixels, uint8 [K, C, T, T]."""

    def __init__(self, shapes: Shapes, config: NetworkConfig) -> None:
        super().__init__()
        self.shapes = shapes
        self.config = config
        self.grid = grid_of(shapes, config)
        self.register_buffer("tiles", None, persistent=False)

    def flat_pixels(self, pixels: Tensor) -> tuple[Tensor | Mosaics, torch.Size]:
        """Return pixels [*B, C, H, W] as [N, C, H, W], and B.

        Numbers of tiles, int16 [*B, h, w], are taken with the tiles that they stand for.

        Raises:
            UserError: for an image of another size than this network was built for, for numbers of
                tiles that it does not know (:func:`read_codes`), and inside ``torch.vmap``.
        """
        if torch._C._functorch.is_batchedtensor(pixels):
            raise UserError(
                "this network computes what repeats in a batch once, which torch.vmap cannot "
                "follow: give TorchRL's value estimators deactivate_vmap=True"
            )
        batch = self.batch_of(pixels)
        if pixels.ndim - len(batch) == 2:
            return self._mosaics(pixels), batch
        if tuple(pixels.shape[-3:]) != self.shapes.image_shape:
            raise UserError(
                f"this network was built for images of {self.shapes.image_shape}, got "
                f"{tuple(pixels.shape[-3:])}: build another for this env or dataset"
            )
        return pixels.reshape(-1, *pixels.shape[-3:]), batch

    def batch_of(self, pixels: Tensor) -> torch.Size:
        """Return the leading dims of images [*B, C, H, W], or of numbers of tiles [*B, h, w]."""
        image = pixels.dtype != CODES or tuple(pixels.shape[-3:]) == self.shapes.image_shape
        return pixels.shape[: -3 if image else -2]

    def _mosaics(self, codes: Tensor) -> Mosaics:
        """Read numbers of tiles [*B, h, w] as images, N of them."""
        if self.tiles is None:
            raise UserError(
                "this network reads pixels and got numbers of tiles: build it for the environment "
                "that shows them, or tell it what they are, networks.read_codes(network, env.tiles)"
            )
        codes = codes.reshape(-1, *codes.shape[-2:])
        if not codes.is_cuda:  # which would have to be waited for
            check_below("images for this network hold tile", codes, len(self.tiles))
        _, height, width = self.shapes.image_shape
        side = self.tiles.shape[-1]
        if (side * codes.shape[1], side * codes.shape[2]) != (height, width):
            raise UserError(
                f"this network was built for images of {height} x {width} pixels, got "
                f"{codes.shape[1]} x {codes.shape[2]} tiles of {side}"
            )
        return Mosaics(self.tiles, codes)


def read_codes(module: nn.Module, tiles: Tensor) -> None:
    """Let networks read numbers of tiles in place of pixels, with what they compute unchanged.

    A frame takes 72 bytes instead of 6,912, and no time to draw. The networks go on reading
    pixels, too.

    Args:
        module: with networks of this package in it, such as a policy.
        tiles: what the numbers stand for, uint8 [K, C, T, T]: ``env.tiles`` of an environment
            that shows codes.

    >>> from ifo_grounding.envs import PickAndPlaceEnv
    >>> from ifo_grounding.networks import from_pretrained, read_codes
    >>> policy, env = from_pretrained("ifo-grounding/move"), PickAndPlaceEnv(codes=True)
    >>> read_codes(policy, env.tiles)
    >>> policy(env.reset())["logits"].shape
    torch.Size([1, 6])
    """
    check_tiles(tiles)
    parts = [part for part in module.modules() if isinstance(part, ImageNetwork)]
    if not parts:
        raise UserError(f"{type(module).__name__} holds no network of this package")
    for part in parts:
        if tiles.shape[1] != part.shapes.image_shape[0]:
            raise UserError(
                f"tiles have {tiles.shape[1]} channels, and images for this network "
                f"{part.shapes.image_shape[0]}"
            )
        part.tiles = tiles.to(next(part.parameters()).device)


def same_batch(**batches: torch.Size) -> None:
    """Raise :class:`UserError` unless all inputs have the same leading dims."""
    if len(set(batches.values())) > 1:
        listed = ", ".join(f"{name} {list(batch)}" for name, batch in batches.items())
        raise UserError(f"inputs must have the same batch dims, got {listed}: expand them first")
