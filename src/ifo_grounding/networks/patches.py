"""Patches of images, and which of them look alike: what repeats is then computed once."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from ifo_grounding.distinct import distinct_rows, places_of
from ifo_grounding.errors import UserError
from ifo_grounding.mosaic import PIXELS_PER_WORD as WORD
from ifo_grounding.mosaic import as_words, assemble, cut
from ifo_grounding.networks.cells import distinct_pairs

FEWEST_WINDOWS = 1 << 12
"""Fewer windows than that are computed as fast as they are compared."""
MOST_TILES = 1 << 15
"""More distinct tiles than that and the numbers of their combinations could overflow."""
MOST_REMEMBERED = 1 << 26
"""Bytes of images up to which it is remembered what was found in them."""

Found = TypeVar("Found")


def remembered(find: Callable[[Tensor, int], Found]) -> Callable[[Tensor, int], Found]:
    """Keep what was found in the last images, for whoever asks about the same ones next.

    Actor and critic, or policy and reward model, read the same images one after the other. To
    compare them takes a twentieth of the time of finding what repeats.
    """
    last: tuple[int, Tensor, Found] | None = None

    @functools.wraps(find)
    def recall(image: Tensor, number: int) -> Found:
        nonlocal last
        if not is_plain(image) or torch.is_inference_mode_enabled():
            return find(image, number)
        # Words are compared many times as fast as bytes.
        words = image if image.shape[-1] % WORD else as_words(image)
        kept = last  # another thread may look at other images meanwhile
        if kept is not None and kept[0] == number and torch.equal(kept[1], words):
            return kept[2]
        found = find(image, number)
        if image.nbytes <= MOST_REMEMBERED:
            last = number, words.clone(), found
        return found

    return recall


def is_plain(image: Tensor) -> bool:
    """Whether images are bytes on a CPU, which can be compared there and then."""
    return image.dtype == torch.uint8 and image.device.type == "cpu"


SLACK = 0.2
"""By which floats may leave 0..1, as images do that are scaled smoothly."""


def as_float(pixels: Tensor, weight: Tensor) -> Tensor:
    """Return pixels in the precision of the weights that read them.

    Bytes are scaled to [0, 1], floats are taken as scaled already, which is checked on a CPU, and
    other numbers are refused.
    """
    if pixels.dtype == torch.uint8:
        return pixels.to(weight.dtype).mul_(1 / 255)
    if not pixels.is_floating_point():
        raise UserError(
            f"images are bytes (uint8) or floats within 0..1, got {pixels.dtype}: convert them "
            "with pixels.to(torch.uint8)"
        )
    if pixels.device.type == "cpu" and pixels.numel():
        low, high = (float(end) for end in pixels.detach().aminmax())
        if not -SLACK <= low <= high <= 1 + SLACK:
            raise UserError(
                f"images of floats are within 0..1, got {low:g}..{high:g}: divide 0..255 by 255, "
                "and leave out what normalises them otherwise"
            )
    return pixels.to(weight.dtype)


def cells_of(image: Tensor | Mosaics, patch: int) -> tuple[Tensor, Tensor]:
    """Cut images [N, C, H, W] into cells, those that look alike once where that pays.

    It pays on a CPU, for bytes of which half or more repeat. Images whose sides are not multiples
    of the patch are padded with black to the right and below.

    Returns:
        Cells, of the image's type, [U, C, patch * patch], and which lies where, int64 [N, h * w].

    >>> cells, where = cells_of(torch.zeros(2, 3, 20, 28, dtype=torch.uint8), 8)
    >>> cells.shape, where.shape
    (torch.Size([1, 3, 64]), torch.Size([2, 12]))
    """
    if isinstance(image, Mosaics) and image.tiles.shape[-1] == patch:
        return image.cells()
    return _remembered_cells(as_pixels(image), patch)


def _distinct_cells(image: Tensor, patch: int) -> tuple[Tensor, Tensor]:
    """Find what :func:`cells_of` returns."""
    below, right = (-size % patch for size in image.shape[-2:])
    image = F.pad(image, (0, right, 0, below)) if below or right else image
    if is_plain(image) and not patch % WORD:
        words = cut(as_words(image), patch, patch // WORD)
        rows, index = distinct_rows(words.flatten(0, 2))
        if 2 * len(rows) <= len(index):
            cells = rows.view(torch.uint8).unflatten(1, (-1, patch**2))
            return cells, index.view(words.shape[:3]).flatten(1)
    pixels = cut(image, patch, patch)
    index = torch.arange(pixels[..., 0].numel(), device=image.device)
    cells = pixels.flatten(0, 2).unflatten(1, (-1, patch**2))
    return cells, index.view(pixels.shape[:3]).flatten(1)


_remembered_cells = remembered(_distinct_cells)


class Mosaics(NamedTuple):
    """Images by the tiles that they are made of."""

    tiles: Tensor
    """uint8 [K, C, T, T]."""
    codes: Tensor
    """Which tile lies where, integer [N, h, w]."""

    def cells(self) -> tuple[Tensor, Tensor]:
        """Return what :func:`cells_of` does of the pixels, where a tile is a cell.

        On a GPU, which would have to be waited for to know which tiles are shown, those are all.
        """
        where = self.codes.flatten(1).long()
        if where.device.type != "cpu":
            return self.tiles.flatten(2), where
        shown, _, index = distinct_pairs(where, where.new_zeros(()), len(self.tiles), 1)
        return self.tiles[shown].flatten(2), index


def as_pixels(image: Tensor | Mosaics) -> Tensor:
    """Return images as pixels, [N, C, H, W]."""
    return assemble(as_words(image.tiles), image.codes) if isinstance(image, Mosaics) else image


class Windows(NamedTuple):
    """The distinct windows of 7 x 7 pixels, 4 apart, that two strided convolutions look at."""

    pixels: Tensor
    """uint8 [U, C, 7, 7]; black where a window reaches beyond the image."""
    top: Tensor
    """Whether the first rows lie above the image, bool [U]."""
    side: Tensor
    """Whether the first columns lie beside the image, bool [U]."""
    where: Tensor
    """Which window lies where, int64 [N, H / 4, W / 4]."""


def distinct_windows(image: Tensor) -> Windows | None:
    """Find the distinct windows that begin 3 pixels before every fourth pixel, both ways.

    A window of a tile of 8 pixels reaches into the last 3 pixels of the tile to the left, of the
    one above, or of both and the one between, so windows are told apart by a few numbers of tiles.

    Returns None where that would not pay, for they are few or half of them differ, and where sides
    of the image [N, C, H, W] are no multiples of 8.

    >>> windows = distinct_windows(torch.zeros(64, 3, 48, 48, dtype=torch.uint8))
    >>> windows.pixels.shape, windows.where.shape
    (torch.Size([9, 3, 7, 7]), torch.Size([64, 12, 12]))
    """
    height, width = (side // WORD for side in image.shape[-2:])
    few = 4 * len(image) * height * width < FEWEST_WINDOWS
    if few or not is_plain(image) or any(side % WORD for side in image.shape[-2:]):
        return None
    cells, where = _distinct_cells(image, WORD)
    if 2 * len(cells) > where.numel() or len(cells) > MOST_TILES:
        return None
    tiles = cells.view(torch.int64)  # [U, C, 8], each number a row of pixels
    here = where.view(-1, height, width)
    strips = (tiles >> 40, tiles[..., 5:], tiles[..., 5:] >> 40)  # the last 3 columns, rows, both
    right, low, corner = (distinct_rows(strip.flatten(1))[1] + 1 for strip in strips)
    left = F.pad(right[here[:, :, :-1]], (1, 0))  # 0 beyond the edge
    above = F.pad(low[here[:, :-1]], (0, 0, 1, 0))
    between = F.pad(corner[here[:, :-1, :-1]], (1, 0, 1, 0))

    base = len(tiles) + 1
    number = here * base
    keys = torch.stack(
        [
            ((number + left) * base + above) * base + between,
            (number * base + above) * base,
            (number + left) * base**2,
            number * base**2,
        ]
    )
    keys += torch.arange(4, device=image.device).view(-1, 1, 1, 1) * base**4
    known, index = torch.unique(keys, return_inverse=True)
    if 2 * len(known) >= index.numel():
        return None
    index = index.view(2, 2, *here.shape).permute(2, 3, 0, 4, 1)  # [N, h, 2, w, 2]
    index = index.reshape(-1, 2 * height, 2 * width)
    place = places_of(index.flatten(), len(known))

    row, across = place // (2 * width) % (2 * height), place % (2 * width)
    windows = F.pad(image, (3, 0, 3, 0)).unfold(2, 7, 4).unfold(3, 7, 4)
    pixels = windows[place // (4 * height * width), :, row, across]
    return Windows(pixels, row == 0, across == 0, index)


class Views(NamedTuple):
    """What the first of several strided convolutions look at, each distinct thing once."""

    windows: Windows
    """What the first two look at."""
    blocks: list[Tensor]
    """What each that follows looks at, [U, 9]: 3 x 3 places, each what lies there plus 1, or 0
    beyond the edge."""
    where: Tensor
    """Which of the last of these lies where, int64 [N, h, w]."""


@remembered
def distinct_views(image: Tensor, layers: int) -> Views | None:
    """Find what strided convolutions of kernel 3 look at, layer by layer, as long as it repeats.

    Returns None where not even the windows of two of the ``layers``, at least two, repeat enough
    in an image [N, C, H, W].
    """
    windows = distinct_windows(image)
    if windows is None:
        return None
    where, blocks = windows.where, list[Tensor]()
    while len(blocks) < layers - 2:
        seen = F.pad(where + 1, (1, 1, 1, 1)).unfold(1, 3, 2).unfold(2, 3, 2).flatten(3)
        distinct, index = distinct_rows(seen.flatten(0, 2))
        if 2 * len(distinct) >= len(index):
            break
        blocks.append(distinct)
        where = index.view(seen.shape[:3])
    return Views(windows, blocks, where)
