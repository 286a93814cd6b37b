"""What demonstrators really did and meant. For evaluation only; no learner reads it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ifo_grounding.data.folder import damaged, load_folder, save_folder
from ifo_grounding.errors import UserError
from ifo_grounding.tasks.goals import Goal

KIND = "ifo-grounding truth"
FIELDS = ("task", "object", "reference", "source", "target", "side")


@dataclass(frozen=True)
class Truth:
    """Actions and goals of recorded demonstrations, kept apart from them.

    >>> from ifo_grounding.data import record_demonstrations
    >>> demos, truth = record_demonstrations("move", 3, keep_truth=True)
    >>> len(truth.actions) == demos.transitions, truth.goals.object.shape
    (True, torch.Size([3]))
    """

    actions: Tensor
    """Action of each transition, in the order of ``Demonstrations.locate()``, uint8 [M]."""
    goals: Goal | None = None
    """What each demonstration was asked for, [N]; None where only the grid's oracle could say."""

    def save(self, folder: str | Path) -> None:
        """Write a folder of its own."""
        goals = {}
        if self.goals is not None:
            goals = {name: getattr(self.goals, name).to(torch.uint8) for name in FIELDS}
        save_folder(folder, KIND, {"actions": self.actions, **goals}, {})

    @classmethod
    def load(cls, folder: str | Path) -> Truth:
        """Read what :meth:`save` wrote; a damaged or foreign folder is a :class:`UserError`."""
        arrays, _ = load_folder(folder, KIND, ("actions",), FIELDS)
        with damaged(folder):
            if any(each.ndim != 1 or each.is_floating_point() for each in arrays.values()):
                raise UserError("actions and goals are rows of whole numbers")
            actions = arrays.pop("actions")
            if not arrays:
                return cls(actions)
            goals = {name: array.long() for name, array in arrays.items()}
            return cls(actions, Goal(**goals, batch_size=[len(arrays["task"])]))
