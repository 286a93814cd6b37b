from __future__ import annotations

import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.seeding import Lots
from ifo_grounding.world import (
    Canvas,
    WorldState,
    random_layout,
    render,
    step,
    tile_index,
    tile_table,
)
from ifo_grounding.world.tiles import N_TILES, PALETTE, TILE_SIZES

sizes = pytest.mark.parametrize("size", TILE_SIZES)
COLOURS = torch.tensor(list(PALETTE.values()), dtype=torch.uint8)


def every_cell() -> WorldState:
    """One world for each thing that a cell can be: box, object, arm, and what the arm holds."""
    appearances = [
        (box, under, arm, held)
        for box in range(8)
        for under in range(13)
        for arm, held in [(False, 0)] + [(True, held) for held in range(13)]
    ]
    state = WorldState.empty(len(appearances), size=3)
    box, under, arm, held = (torch.tensor(column) for column in zip(*appearances, strict=True))
    state.arm = torch.where(arm, 4, 0)
    state.held = held.to(torch.uint8)
    state.objects[:, 4] = under.to(torch.uint8)
    state.boxes[:, 4] = box.to(torch.uint8)
    return state


def test_every_look_of_a_cell_has_a_tile_of_its_own():
    index = tile_index(every_cell())[:, 1, 1]
    assert sorted(index.tolist()) == list(range(N_TILES)) == list(range(1456))


@sizes
def test_tiles_differ_in_whole_pixels_and_not_in_shades(size):
    tiles = tile_table(size)
    assert tiles.shape == (1456, 3, size, size) and tiles.dtype == torch.uint8
    tiles = tiles.flatten(1).float()
    # As far as a pixel that turns from black to gray.
    assert torch.cdist(tiles, tiles).fill_diagonal_(torch.inf).min() > 120


@sizes
def test_a_frame_is_the_mosaic_of_its_cells(size):
    draw = torch.Generator().manual_seed(size)
    state = random_layout(Lots(0, torch.arange(5)))
    for _ in range(8):
        state = step(state, torch.randint(5, (5,), generator=draw))
    shown = render(state, size).unflatten(-1, (6, size)).unflatten(-3, (6, size))
    tiles = tile_table(size)[tile_index(state).long()]
    assert torch.equal(shown.permute(0, 2, 4, 1, 3, 5), tiles)


def share(cell: torch.Tensor, colour: torch.Tensor) -> float:
    """Share of a cell's pixels [3, T, T] that have a colour."""
    return float((cell == colour.view(3, 1, 1)).all(0).float().mean())


@sizes
def test_things_are_seen_by_their_colours(size):
    tiles, white = tile_table(size), torch.full((3,), 255)
    for number in range(1, 8):
        assert share(tiles[number], COLOURS[2 + number]) > 0.75
    for number in range(1, 13):
        assert share(tiles[8 * number], COLOURS[(number - 1) // 4]) > 0.08
    floor, arm = tiles[0], tiles[104]
    assert share(floor, white) == 0 and share(arm[:, 2:-2, 2:-2], white) == 0
    for edge in (arm[:, 0], arm[:, -1], arm[..., 0], arm[..., -1]):
        assert (edge == 255).all()


def test_an_unknown_tile_size_is_refused():
    with pytest.raises(UserError, match="8, 16, 32"):
        render(WorldState.empty(1), 12)


@sizes
@pytest.mark.parametrize("worlds", [8, 232])  # drawn anew, and where cells changed
def test_a_canvas_shows_what_is_rendered(size, worlds):
    canvas, state = Canvas(size), random_layout(Lots(0, torch.arange(worlds)))
    for turn in range(8):
        if turn == 4:  # some worlds begin anew, and then all of them
            state[: worlds // 8] = random_layout(Lots(1, torch.arange(worlds // 8)))
        if turn == 6:
            state = random_layout(Lots(2, torch.arange(worlds)))
        drawn = canvas.draw(state)
        assert torch.equal(drawn, render(state, size))
        drawn.zero_()  # is the caller's own
        state = step(state, torch.randint(6, (worlds,)))
    assert torch.equal(canvas.draw(state[:5]), render(state[:5], size))
