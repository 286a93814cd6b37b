"""Random initial states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ifo_grounding.errors import UserError, share, whole
from ifo_grounding.seeding import Lots
from ifo_grounding.world.state import N_BOXES, N_KINDS, WorldState

FINE = 1 << 30
"""Parts into which a probability is divided."""


@dataclass(frozen=True)
class Layout:
    """How many things a scene holds, and where."""

    size: int = 6
    """Cells along one side of the grid, 3..16."""
    objects: tuple[int, int] = (4, 8)
    """Fewest and most objects."""
    boxes: tuple[int, int] = (2, 4)
    """Fewest and most boxes; their colours differ."""
    inside: float = 0.35
    """Probability that an object starts inside a box, while boxes are free: each holds one."""
    excluded_kinds: tuple[int, ...] = ()
    """Object kinds that no scene shows."""

    def __post_init__(self) -> None:
        if not 3 <= whole("size", self.size) <= 16:
            raise UserError(f"size must be 3..16 cells, got {self.size}")
        for name, counts, most in (
            ("objects", self.objects, self.size**2),
            ("boxes", self.boxes, N_BOXES),
        ):
            if np.ndim(counts) != 1 or len(counts) != 2 or not 0 <= counts[0] <= counts[1] <= most:
                raise UserError(f"{name} must be (fewest, most) within 0..{most}, got {counts}")
        if self.objects[1] + self.boxes[1] > self.size**2:
            raise UserError(
                f"{self.objects[1]} objects and {self.boxes[1]} boxes do not fit on "
                f"{self.size}x{self.size} cells: ask for fewer or a larger grid"
            )
        share("inside", self.inside)
        if not set(range(1, N_KINDS + 1)) - set(self.excluded_kinds):
            raise UserError("excluded_kinds leaves no kind of object")
        for name in ("objects", "boxes", "excluded_kinds"):  # equal layouts are one, hashable
            object.__setattr__(self, name, tuple(getattr(self, name)))


def random_layout(lots: Lots, layout: Layout | None = None) -> WorldState:
    """Draw initial states: objects and boxes in distinct places, the arm anywhere, nothing held.

    >>> random_layout(Lots(0, torch.arange(3))).held.tolist()
    [0, 0, 0]
    """
    layout = layout or Layout()
    batch, device, cells = len(lots), lots.device, layout.size**2
    most_objects, most_boxes = layout.objects[1], layout.boxes[1]

    def count(low: int, high: int) -> Tensor:
        return low + lots.below(high - low + 1)

    places = lots.distinct(cells, most_boxes + most_objects)

    colours = 1 + lots.distinct(N_BOXES, most_boxes)
    n_boxes = count(*layout.boxes)
    box_exists = torch.arange(most_boxes, device=device) < n_boxes
    boxes = torch.zeros(batch, cells, dtype=torch.uint8, device=device)
    boxes.scatter_(-1, places[:, :most_boxes], (colours * box_exists).to(torch.uint8))

    allowed = [k for k in range(1, N_KINDS + 1) if k not in layout.excluded_kinds]
    kinds = torch.tensor(allowed, device=device)[lots.below(len(allowed), most_objects)]
    number = torch.arange(most_objects, device=device)
    kinds = kinds * (number < count(*layout.objects))

    wants_box = (lots.below(FINE, most_objects) < round(layout.inside * FINE)) & (kinds > 0)
    rank = wants_box.long().cumsum(-1) - 1
    in_box = wants_box & (rank < n_boxes)
    cell = places.gather(-1, torch.where(in_box, rank, most_boxes + number))
    # Cells are distinct, so that adding writes each kind once and nothing where there is none.
    objects = torch.zeros(batch, cells, dtype=torch.uint8, device=device)
    objects.scatter_add_(-1, cell, kinds.to(torch.uint8))

    arm = lots.below(cells).squeeze(-1)
    held = torch.zeros(batch, dtype=torch.uint8, device=device)
    return WorldState(arm=arm, held=held, objects=objects, boxes=boxes, batch_size=[batch])
