import pytest
import torch

from ifo_grounding import world
from ifo_grounding.errors import UserError
from ifo_grounding.seeding import Lots
from ifo_grounding.world.tiles import N_TILES, PALETTE, TILE_SIZES

sizes = pytest.mark.parametrize("size", TILE_SIZES)
COLOURS = torch.tensor(list(PALETTE.values()), dtype=torch.uint8)


def every_cell() -> world.WorldState:
    """One world for each thing that a cell can be: box, object, arm, and what the arm holds."""
    appearances = [
        (box, under, arm, held)
        for box in range(8)
        for under in range(13)
        for arm, held in [(False, 0)] + [(True, held) for held in range(13)]
    ]
    state = world.WorldState.empty(len(appearances), size=3)
    box, under, arm, held = (torch.tensor(column) for column in zip(*appearances, strict=True))
    state.arm = torch.where(arm, 4, 0)
    state.held = held.to(torch.uint8)
    state.objects[:, 4] = under.to(torch.uint8)
    state.boxes[:, 4] = box.to(torch.uint8)
    return state


def test_every_look_of_a_cell_has_a_tile_of_its_own():
    index = world.tile_index(every_cell())[:, 1, 1]
    assert sorted(index.tolist()) == list(range(N_TILES)) == list(range(1456))


@sizes
def test_tiles_differ_in_whole_pixels_and_not_in_shades(size):
    tiles = world.tile_table(size)
    assert tiles.shape == (1456, 3, size, size) and tiles.dtype == torch.uint8
    tiles = tiles.flatten(1).float()
    # As far as a pixel that turns from black to gray.
    assert torch.cdist(tiles, tiles).fill_diagonal_(torch.inf).min() > 120


@sizes
def test_a_frame_is_the_mosaic_of_its_cells(size):
    draw = torch.Generator().manual_seed(size)
    state = world.random_layout(Lots(0, torch.arange(5)))
    for _ in range(8):
        state = world.step(state, torch.randint(5, (5,), generator=draw))
    shown = world.render(state, size).unflatten(-1, (6, size)).unflatten(-3, (6, size))
    tiles = world.tile_table(size)[world.tile_index(state).long()]
    assert torch.equal(shown.permute(0, 2, 4, 1, 3, 5), tiles)


def test_an_unknown_tile_size_is_refused():
    with pytest.raises(UserError, match="8, 16, 32"):
        world.render(world.WorldState.empty(1), 12)
