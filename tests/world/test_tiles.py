from __future__ import annotations

import pytest
import torch

from ifo_grounding.errors import UserError
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

SIZES = (8, 16, 32)


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


@pytest.mark.parametrize("size", SIZES)
def test_all_reachable_tile_pictures_are_distinct(size):
    tiles = tile_table(size)
    assert tiles.shape == (1456, 3, size, size)
    assert tiles.dtype == torch.uint8
    assert len(tiles.flatten(1).unique(dim=0)) == len(tiles)
    pictures = render(every_cell(), size)[:, :, size : 2 * size, size : 2 * size]
    assert len(pictures.flatten(1).unique(dim=0)) == 1456


@pytest.mark.parametrize("size", SIZES)
def test_tiles_differ_in_whole_pixels_and_not_in_shades(size):
    tiles = tile_table(size).flatten(1).double()
    distance = torch.cdist(tiles, tiles).fill_diagonal_(torch.inf)
    assert distance.min() > 120  # as far as a pixel that turns from black to gray


@pytest.mark.parametrize("size", SIZES)
def test_a_frame_is_the_mosaic_of_its_cells(size):
    draw = torch.Generator().manual_seed(size)
    state = random_layout(5, generator=draw)
    for _ in range(8):
        state = step(state, torch.randint(5, (5,), generator=draw))
    frames, tiles, index = render(state, size), tile_table(size), tile_index(state)
    assert frames.shape == (5, 3, 6 * size, 6 * size)
    for world in range(5):
        for row in range(6):
            for column in range(6):
                shown = frames[world, :, row * size :, column * size :][:, :size, :size]
                assert torch.equal(shown, tiles[index[world, row, column]])


@pytest.mark.parametrize("size", SIZES)
def test_the_arm_is_a_white_border(size):
    state = WorldState.empty(1)
    frame = render(state, size)[0, :, :size, :size]
    for edge in (frame[:, 0], frame[:, -1], frame[:, :, 0], frame[:, :, -1]):
        assert (edge == 255).all()
    assert (frame[:, 2:-2, 2:-2] < 255).all() or size == 8
    assert (render(state, size)[0, :, :, size:] < 255).all()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("number", range(1, 8))
def test_a_box_fills_its_cell(size, number):
    state = WorldState.empty(1)
    state.boxes[0, 7] = number
    cell = render(state, size)[0, :, size : 2 * size, size : 2 * size]
    colour = list(PALETTE.values())[2 + number]
    same = (cell.permute(1, 2, 0) == torch.tensor(colour, dtype=torch.uint8)).all(-1)
    assert same.float().mean() > 0.75


@pytest.mark.parametrize("size", SIZES)
def test_an_object_shows_its_colour(size):
    for number in range(1, 13):
        state = WorldState.empty(1)
        state.objects[0, 35] = number
        cell = render(state, size)[0, :, -size:, -size:]
        colour = list(PALETTE.values())[(number - 1) // 4]
        same = (cell.permute(1, 2, 0) == torch.tensor(colour, dtype=torch.uint8)).all(-1)
        assert same.float().mean() > 0.08


def test_an_unknown_tile_size_is_refused():
    assert TILE_SIZES == SIZES
    with pytest.raises(UserError, match="8, 16, 32"):
        render(WorldState.empty(1), 12)


@pytest.mark.parametrize("size", TILE_SIZES)
@pytest.mark.parametrize("worlds", [8, 256])  # drawn anew, and where cells changed
def test_a_canvas_shows_what_is_rendered(size, worlds):
    canvas, state = Canvas(size), random_layout(worlds)
    for turn in range(12):
        if turn == 6:  # some worlds begin anew, and then all of them
            state[: worlds // 8] = random_layout(worlds // 8)
        if turn == 9:
            state = random_layout(worlds)
        drawn = canvas.draw(state)
        assert torch.equal(drawn, render(state, size))
        drawn.zero_()  # is the caller's own
        state = step(state, torch.randint(6, (worlds,)))
    assert torch.equal(canvas.draw(state[:5]), render(state[:5], size))
