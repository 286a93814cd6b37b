"""What demonstrators really did. For evaluation only; no learner reads it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from ifo_grounding.data.folder import load_folder, save_folder

KIND = "ifo-grounding truth"


@dataclass(frozen=True)
class Truth:
    """Actions of recorded demonstrations, kept apart from them.

    >>> from ifo_grounding.data import record_demonstrations
    >>> demos, truth = record_demonstrations("move", 3, keep_truth=True)
    >>> len(truth.actions) == demos.transitions
    True
    """

    actions: Tensor
    """Action of each transition, in the order of ``Demonstrations.locate()``, uint8 [M]."""

    def save(self, folder: str | Path) -> None:
        """Write a folder of its own."""
        save_folder(folder, KIND, {"actions": self.actions}, {})

    @classmethod
    def load(cls, folder: str | Path) -> Truth:
        """Read what :meth:`save` wrote; a damaged or foreign folder is an error."""
        return cls(load_folder(folder, KIND, ("actions",))[0]["actions"])
