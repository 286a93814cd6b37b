"""Pictures of worlds: every state of a cell is a tile, and a frame is a mosaic of tiles.

A tile shows a box as a filled cell, an object as its shape, and the arm as a white border. A held
object is drawn small in a white hand at the upper left; what then lies beneath is drawn small at
the lower right. Tiles of 8 pixels are drawn by hand, larger ones as outlined shapes.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from ifo_grounding import mosaic
from ifo_grounding.errors import check_choice
from ifo_grounding.world.state import BOX_COLOURS, COLOURS, N_BOXES, N_KINDS, SHAPES, WorldState

TILE_SIZES = (8, 16, 32)
PLAIN = (N_BOXES + 1) * (N_KINDS + 1)
"""States of a cell without the arm."""
N_TILES = PLAIN * (N_KINDS + 2)

FLOOR = (26, 28, 34)
GRID = (46, 49, 58)
OUTLINE = (14, 15, 18)
WHITE = (255, 255, 255)
PALETTE = {
    "red": (226, 48, 40),
    "yellow": (250, 212, 38),
    "blue": (38, 84, 242),
    "orange": (240, 138, 36),
    "green": (44, 150, 72),
    "purple": (160, 92, 205),
    "pink": (246, 158, 198),
    "brown": (128, 82, 46),
    "gray": (132, 134, 140),
    "cyan": (84, 204, 214),
}

SPRITES: dict[str, tuple[str, ...]] = {
    "circle": (".####.", "######", "######", "######", "######", ".####."),
    "rectangle": ("......", "######", "######", "######", "######", "......"),
    "diamond": ("..##..", ".####.", "######", "######", ".####.", "..##.."),
    "triangle": ("......", "..##..", "..##..", ".####.", ".####.", "######"),
}
SMALL_SPRITES: dict[str, tuple[str, ...]] = {
    "circle": ("###", "#.#", "###"),
    "rectangle": ("...", "###", "###"),
    "diamond": (".#.", "###", ".#."),
    "triangle": (".#.", ".#.", "###"),
}
SUPERSAMPLING = 8
FEWEST_CELLS = 1 << 13
"""Fewer cells than that are drawn as fast as they are compared."""
MOST_CHANGED = 4
"""Where more than one in so many cells changed, drawing all takes no longer."""


def tile_index(state: WorldState) -> Tensor:
    """Return which tile each cell shows, int64 [*B, size, size].

    >>> tile_index(WorldState.empty(1, size=3)).flatten().tolist()
    [104, 0, 0, 0, 0, 0, 0, 0, 0]
    """
    return _tile_index(state).long()


def _tile_index(state: WorldState) -> Tensor:
    """Return :func:`tile_index` as int16, in which it is computed."""
    size = state.size
    index = state.boxes.to(torch.int16).add_(state.objects, alpha=N_BOXES + 1)
    carried = state.held.to(torch.int16).add_(1).mul_(PLAIN)
    index.scatter_add_(-1, state.arm.unsqueeze(-1), carried.unsqueeze(-1))
    return index.unflatten(-1, (size, size))


def render(state: WorldState, tile_size: int = 8) -> Tensor:
    """Draw worlds.

    Args:
        state: worlds [*B].
        tile_size: pixels along one side of a cell: 8, 16 or 32.

    Returns:
        Pixels, uint8 [*B, 3, size * tile_size, size * tile_size].

    >>> render(WorldState.empty(2, size=6)).shape
    torch.Size([2, 3, 48, 48])
    """
    return mosaic.assemble(_words(tile_size, str(state.arm.device)), _tile_index(state))


class Canvas:
    """Draws the same worlds again and again: on a CPU, only the cells that changed.

    Its pictures are those of :func:`render`.

    Args:
        tile_size: pixels along one side of a cell: 8, 16 or 32.

    >>> canvas, state = Canvas(), WorldState.empty(2, size=6)
    >>> bool((canvas.draw(state) == render(state)).all())
    True
    """

    def __init__(self, tile_size: int = 8) -> None:
        self.tile_size = tile_size
        self._shown: Tensor | None = None
        self._frames = torch.empty(0)

    def draw(self, state: WorldState) -> Tensor:
        """Draw worlds [N]: pixels, uint8 [N, 3, H, W], which the caller may write to."""
        shown, shape = self._shown, (*state.arm.shape, state.size, state.size)
        words = _words(self.tile_size, str(state.arm.device))
        # A GPU would have to be waited for, to know what changed.
        if state.arm.device.type != "cpu" or math.prod(shape) < FEWEST_CELLS:
            return mosaic.assemble(words, _tile_index(state))
        index = _tile_index(state)
        if shown is None or shown.shape != shape or not self._redraw(index, shown):
            self._frames = mosaic.assemble(words, index)
        self._shown = index
        return self._frames.clone()

    def _redraw(self, index: Tensor, shown: Tensor) -> bool:
        """Draw the cells that changed, if they are few enough."""
        tiles = index.view(-1)
        changed = tiles.ne(shown.view(-1)).nonzero().squeeze(-1)
        if MOST_CHANGED * len(changed) > len(tiles):
            return False
        new = tiles.index_select(0, changed).long()
        mosaic.lay(self._frames, mosaic.words(tile_table(self.tile_size)), changed, new)
        return True


@functools.cache
def tile_table(tile_size: int = 8) -> Tensor:
    """Return the pictures of all states of a cell, uint8 [1456, 3, T, T]; do not write to it."""
    check_choice("tile size", tile_size, TILE_SIZES)
    if tile_size == 8:
        tiles = np.stack([_draw_small(number) for number in range(N_TILES)])
    else:
        tiles = _draw_large(tile_size)
    return torch.from_numpy(tiles).permute(0, 3, 1, 2).contiguous()


@functools.cache
def _words(tile_size: int, device: str) -> Tensor:
    words = mosaic.words(tile_table(tile_size)).to(device)
    return words.permute(1, 2, 0, 3).contiguous().permute(2, 0, 1, 3)  # as it is gathered from


def _look(kind: int) -> tuple[str, tuple[int, int, int]]:
    colour, shape = divmod(kind - 1, len(SHAPES))
    return SHAPES[shape], PALETTE[COLOURS[colour]]


def _draw_small(number: int) -> np.ndarray:
    """Draw one tile of 8 pixels; ``arm`` is 0 for none, else 1 + the kind that it holds."""
    rest, box = divmod(number, N_BOXES + 1)
    arm, under = divmod(rest, N_KINDS + 1)
    held = max(arm - 1, 0)
    tile = np.empty((8, 8, 3), np.uint8)
    tile[:] = PALETTE[BOX_COLOURS[box - 1]] if box else FLOOR
    if held:
        tile[1:4, 1:4] = WHITE
        _stamp(tile, held, SMALL_SPRITES, 1, 1)
    if under:
        sprites, corner = (SMALL_SPRITES, 4) if held else (SPRITES, 1)
        _stamp(tile, under, sprites, corner, corner)
    if arm:
        tile[[0, -1]] = tile[:, [0, -1]] = WHITE
    return tile


def _stamp(
    tile: np.ndarray, kind: int, sprites: dict[str, tuple[str, ...]], top: int, left: int
) -> None:
    shape, colour = _look(kind)
    mask = np.array([[pixel == "#" for pixel in row] for row in sprites[shape]])
    height, width = mask.shape
    tile[top : top + height, left : left + width][mask] = colour


def _draw_large(size: int) -> np.ndarray:
    """Draw all tiles as outlined shapes: smooth masks, laid over each other as paint."""
    number = np.arange(N_TILES)
    rest, box = np.divmod(number, N_BOXES + 1)
    arm, under = np.divmod(rest, N_KINDS + 1)
    held = np.maximum(arm - 1, 0)
    holding = held > 0

    tiles = np.empty((N_TILES, size, size, 3), np.float32)
    tiles[:] = GRID
    ground = np.array([FLOOR, *(PALETTE[colour] for colour in BOX_COLOURS)], np.float32)
    _paint(tiles, _square(size, 0.5, 0.5 - 0.5 / size), ground[box])
    _paint(tiles, _square(size, 0.3, 0.24) * holding[:, None, None], _rgb(WHITE))
    _paint_objects(tiles, held, 0.31, 0.19)
    _paint_objects(tiles, np.where(holding, under, 0), 0.69, 0.17)
    _paint_objects(tiles, np.where(holding, 0, under), 0.5, 0.34)
    border = 1 - _square(size, 0.5, 0.5 - 0.085)
    _paint(tiles, border * (arm > 0)[:, None, None], _rgb(WHITE))
    return tiles.round().astype(np.uint8)


def _paint(tiles: np.ndarray, alpha: np.ndarray, colour: np.ndarray) -> None:
    """Blend colours [N, 3] or [3] into tiles [N, T, T, 3] where alpha [N, T, T] or [T, T] is."""
    alpha = alpha[..., None]
    tiles += alpha * (colour.reshape(-1, 1, 1, 3) - tiles)


def _rgb(colour: tuple[int, int, int]) -> np.ndarray:
    return np.array(colour, np.float32)


def _paint_objects(tiles: np.ndarray, kinds: np.ndarray, centre: float, radius: float) -> None:
    size = tiles.shape[1]
    for kind in range(1, N_KINDS + 1):
        rows = np.flatnonzero(kinds == kind)
        shape, colour = _look(kind)
        painted = tiles[rows]
        _paint(painted, _cover(size, shape, centre, radius), _rgb(OUTLINE))
        _paint(painted, _cover(size, shape, centre, radius * 0.84), _rgb(colour))
        tiles[rows] = painted


def _square(size: int, centre: float, radius: float) -> np.ndarray:
    return _cover(size, "square", centre, radius)


@functools.cache
def _cover(size: int, shape: str, centre: float, radius: float) -> np.ndarray:
    """Return the share of each pixel that a shape covers, float32 [T, T]."""
    fine = size * SUPERSAMPLING
    axis = ((np.arange(fine) + 0.5) / fine - centre) / radius
    x, y = np.meshgrid(axis, axis)
    covered = _inside(shape, x, y).reshape(size, SUPERSAMPLING, size, SUPERSAMPLING)
    return covered.mean((1, 3), dtype=np.float32)


def _inside(shape: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return where a shape of radius one around the origin covers the plane."""
    if shape == "square":
        return np.maximum(abs(x), abs(y)) < 1.0
    if shape == "circle":
        return x**2 + y**2 < 0.95
    if shape == "rectangle":
        return (abs(x) < 1.0) & (abs(y) < 0.66)
    if shape == "diamond":
        return abs(x) + abs(y) < 1.1
    return (y < 0.8) & (y > -1.0) & (abs(x) < (y + 1.0) * 0.58)
