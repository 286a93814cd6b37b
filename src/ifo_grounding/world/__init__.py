"""What is true: a pure, batched grid world in plain torch."""

from ifo_grounding.world.dynamics import neighbour, step
from ifo_grounding.world.layout import Layout, random_layout
from ifo_grounding.world.state import (
    BOX_COLOURS,
    COLOURS,
    N_BOXES,
    N_KINDS,
    SHAPES,
    WorldState,
    kind,
    kind_name,
)
from ifo_grounding.world.tiles import Canvas, render, tile_index, tile_table

__all__ = [
    "BOX_COLOURS",
    "COLOURS",
    "N_BOXES",
    "N_KINDS",
    "SHAPES",
    "Canvas",
    "Layout",
    "WorldState",
    "kind",
    "kind_name",
    "neighbour",
    "random_layout",
    "render",
    "step",
    "tile_index",
    "tile_table",
]
