"""Pictures of worlds: every state of a cell is a tile, and a frame is a mosaic of tiles.

A tile shows a box as a filled cell, an object as its shape, and the arm as a white border. A held
object is drawn small in a white hand at the upper left; what then lies beneath is drawn small at
the lower right. Tiles of 8 pixels are drawn by hand, larger ones as outlined shapes.
"""

from __future__ import annotations

import functools

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
    "square": ("######",) * 6,
    "circle": (".####.", "######", "######", "######", "######", ".####."),
    "rectangle": ("......", "######", "######", "######", "######", "......"),
    "diamond": ("..##..", ".####.", "######", "######", ".####.", "..##.."),
    "triangle": ("......", "..##..", "..##..", ".####.", ".####.", "######"),
}
SMALL_SPRITES: dict[str, tuple[str, ...]] = {
    "square": ("###",) * 3,
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
    """Return which tile of :func:`tile_table` each cell shows, int16 [*B, size, size].

    >>> tile_index(WorldState.empty(1, size=3)).flatten().tolist()
    [104, 0, 0, 0, 0, 0, 0, 0, 0]
    """
    index = state.boxes.to(torch.int16).add_(state.objects, alpha=N_BOXES + 1)
    carried = state.held.to(torch.int16).add_(1).mul_(PLAIN)
    index.scatter_add_(-1, state.arm.unsqueeze(-1), carried.unsqueeze(-1))
    return index.unflatten(-1, (state.size, state.size))


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
    return mosaic.assemble(_words(tile_size, str(state.arm.device)), tile_index(state))


class Canvas:
    """Draws the same worlds again and again: on a CPU, only the cells that changed.

    Its pictures are those of :func:`render`.

    >>> canvas, state = Canvas(), WorldState.empty(2, size=6)
    >>> bool((canvas.draw(state) == render(state)).all())
    True
    """

    def __init__(self, tile_size: int = 8) -> None:
        self.tile_size = tile_size
        self._shown = self._frames = torch.empty(0)

    def draw(self, state: WorldState) -> Tensor:
        """Draw worlds [N]: pixels, uint8 [N, 3, H, W], which the caller may write to."""
        index, words = tile_index(state), _words(self.tile_size, str(state.arm.device))
        # A GPU would have to be waited for, to know what changed.
        if state.arm.device.type != "cpu" or index.numel() < FEWEST_CELLS:
            return mosaic.assemble(words, index)
        if self._shown.shape != index.shape:
            self._shown = torch.full_like(index, -1)  # all cells are new
        tiles = index.view(-1)
        changed = tiles.ne(self._shown.view(-1)).nonzero().squeeze(-1)
        if MOST_CHANGED * len(changed) > len(tiles):
            self._frames = mosaic.assemble(words, index)
        else:
            table = mosaic.as_words(tile_table(self.tile_size))
            mosaic.lay(self._frames, table, changed, tiles.index_select(0, changed))
        self._shown = index
        return self._frames.clone()


@functools.cache
def tile_table(tile_size: int = 8) -> Tensor:
    """Return the pictures of all states of a cell, uint8 [1456, 3, T, T]; do not write to it."""
    check_choice("tile size", tile_size, TILE_SIZES)
    rest, box = np.divmod(np.arange(N_TILES), N_BOXES + 1)
    arm, under = np.divmod(rest, N_KINDS + 1)
    held = np.maximum(arm - 1, 0)
    ground = np.array([FLOOR, *(PALETTE[colour] for colour in BOX_COLOURS)], np.float32)
    tiles = np.broadcast_to(ground[box, None, None], (N_TILES, tile_size, tile_size, 3)).copy()
    if tile_size > 8:
        _paint(tiles, box >= 0, 1 - _cover(tile_size, "square", 0.5, 0.5 - 0.5 / tile_size), GRID)
    _paint(tiles, held > 0, _cover(tile_size, "square", 0.3, 0.24), WHITE)
    for kinds, centre, radius in (
        (held, 0.31, 0.19),
        (np.where(held > 0, under, 0), 0.69, 0.17),
        (np.where(held > 0, 0, under), 0.5, 0.34),
    ):
        for kind in range(1, N_KINDS + 1):
            colour, shape = divmod(kind - 1, len(SHAPES))
            outline = _cover(tile_size, SHAPES[shape], centre, radius)
            inner = _cover(tile_size, SHAPES[shape], centre, radius * 0.84)
            _paint(tiles, kinds == kind, outline, OUTLINE)
            _paint(tiles, kinds == kind, inner, PALETTE[COLOURS[colour]])
    _paint(tiles, arm > 0, 1 - _cover(tile_size, "square", 0.5, 0.5 - 0.085), WHITE)
    return torch.from_numpy(tiles.round().astype(np.uint8)).permute(0, 3, 1, 2).contiguous()


@functools.cache
def _words(tile_size: int, device: str) -> Tensor:
    words = mosaic.as_words(tile_table(tile_size)).to(device)
    return words.permute(1, 2, 0, 3).contiguous().permute(2, 0, 1, 3)  # as it is gathered from


def _paint(
    tiles: np.ndarray, rows: np.ndarray, alpha: np.ndarray, colour: tuple[int, int, int]
) -> None:
    """Blend a colour into some tiles [N, T, T, 3] as far as alpha [T, T] says."""
    painted = tiles[rows]
    tiles[rows] = painted + alpha[..., None] * (np.array(colour, np.float32) - painted)


@functools.cache
def _cover(size: int, shape: str, centre: float, radius: float) -> np.ndarray:
    """Return the share of each pixel that a shape covers, float32 [T, T]."""
    if size == 8:
        sprite = SPRITES[shape] if centre == 0.5 else SMALL_SPRITES[shape]
        corner = 4 if centre > 0.5 else 1
        drawn = [[float(pixel == "#") for pixel in row] for row in sprite]
        return np.pad(np.array(drawn, np.float32), (corner, 8 - corner - len(sprite)))
    fine = size * SUPERSAMPLING
    axis = ((np.arange(fine) + 0.5) / fine - centre) / radius
    x, y = np.meshgrid(axis, axis)
    covered = {
        "square": np.maximum(abs(x), abs(y)) < 1.0,
        "circle": x**2 + y**2 < 0.95,
        "rectangle": (abs(x) < 1.0) & (abs(y) < 0.66),
        "diamond": abs(x) + abs(y) < 1.1,
        "triangle": (y < 0.8) & (y > -1.0) & (abs(x) < (y + 1.0) * 0.58),
    }[shape]
    covered = covered.reshape(size, SUPERSAMPLING, size, SUPERSAMPLING)
    return covered.mean((1, 3), dtype=np.float32)
