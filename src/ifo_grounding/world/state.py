"""The true state of a batch of worlds, which no learner sees."""

from __future__ import annotations

import math

import torch
from tensordict import TensorClass
from torch import Tensor

from ifo_grounding.errors import check_choice

SHAPES = ("circle", "rectangle", "diamond", "triangle")
COLOURS = ("red", "yellow", "blue")
BOX_COLOURS = ("orange", "green", "purple", "pink", "brown", "gray", "cyan")
N_KINDS = len(SHAPES) * len(COLOURS)
N_BOXES = len(BOX_COLOURS)


def kind(colour: str, shape: str) -> int:
    """Return the number of an object kind, 1..12; 0 means no object.

    >>> kind("red", "circle"), kind("blue", "triangle")
    (1, 12)
    """
    check_choice("colour", colour, COLOURS)
    check_choice("shape", shape, SHAPES)
    return 1 + COLOURS.index(colour) * len(SHAPES) + SHAPES.index(shape)


def kind_name(number: int) -> str:
    """Return what :func:`kind` numbered, such as ``"red circle"``.

    >>> kind_name(12)
    'blue triangle'
    """
    colour, shape = divmod(int(number) - 1, len(SHAPES))
    return f"{COLOURS[colour]} {SHAPES[shape]}"


class WorldState(TensorClass):
    """A batch of worlds: an arm, what it holds, objects and boxes on a square grid.

    Cells are numbered row by row from the top left. Objects of one kind (colour and shape) are
    alike: the world does not tell them apart.

    >>> import torch
    >>> state = WorldState.empty(2, size=6)
    >>> state.arm.shape, state.objects.shape, state.size
    (torch.Size([2]), torch.Size([2, 36]), 6)
    """

    arm: Tensor
    """Cell of the arm, int64 [*B]."""
    held: Tensor
    """Kind of the object in the hand, 0 for none, uint8 [*B]."""
    objects: Tensor
    """Kind of the object in each cell, 0 for none, uint8 [*B, size * size]."""
    boxes: Tensor
    """Colour of the box in each cell (1..7), 0 for none, uint8 [*B, size * size]."""

    @property
    def size(self) -> int:
        """Cells along one side of the grid."""
        return math.isqrt(self.objects.shape[-1])

    @classmethod
    def empty(cls, batch: int, size: int = 6) -> WorldState:
        """Return worlds without objects or boxes, the arm in the top left cell."""
        return cls(
            arm=torch.zeros(batch, dtype=torch.int64),
            held=torch.zeros(batch, dtype=torch.uint8),
            objects=torch.zeros(batch, size * size, dtype=torch.uint8),
            boxes=torch.zeros(batch, size * size, dtype=torch.uint8),
            batch_size=[batch],
        )
