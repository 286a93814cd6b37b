"""Recorded demonstrations at a glance: what each shows, and which of them look wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ifo_grounding.data import Demonstrations, label_demonstrations

SURE = 0.5
"""A label below this probability is doubtful."""
JUMP = 4.0
"""A change of so many times the median one is a jump: frames may be missing."""


@dataclass(frozen=True)
class Recorded:
    """One demonstration, and what looks wrong about it."""

    number: int
    """Its place among the demonstrations."""
    sentence: str
    """Its instruction."""
    labels: list[str]
    """Action that the inverse model names for each of T steps; empty without a model."""
    confidence: list[float]
    """Probability that it gives to each of them."""
    doubts: list[str]
    """What looks wrong, in words."""


def look(demos: Demonstrations, inverse: Any = None, actions: Sequence[str] = ()) -> list[Recorded]:
    """Go through demonstrations, those first that look wrong.

    An episode is doubtful that shows no stop, stands still before it, changes more at once than
    episodes mostly do, or whose labels the inverse model is unsure of.

    Args:
        demos: with a vocabulary.
        inverse: an inverse model for their images.
        actions: names of its actions.

    >>> import torch
    >>> frames = [torch.zeros(3, 3, 48, 48, dtype=torch.uint8) for _ in range(2)]
    >>> [each.doubts for each in look(Demonstrations.from_arrays(frames, ["go up", "stay"]))]
    [['stands still at step 1'], ['stands still at step 1']]
    """
    changes = _changes(demos)
    moved = changes[changes > 0]
    usual = float(moved.median()) if len(moved) else 0.0
    labels, sure = torch.zeros(0), torch.zeros(0)
    if inverse is not None and demos.transitions:
        report = label_demonstrations(demos, inverse, progress=False).report
        labels, sure = report.actions.long(), report.confidence
    found, ends = [], (demos.lengths - 1).cumsum(0).tolist()
    closed, sentences = demos.closed.tolist(), demos.sentences()
    for number, (begin, end) in enumerate(zip([0, *ends], ends, strict=False)):
        changed = changes[begin:end]
        suspects = {
            "stands still": changed[: len(changed) - closed[number]] == 0,
            "jumps": changed > JUMP * usual,
            "an unsure label": sure[begin:end] < SURE,
        }
        doubts = [] if closed[number] else ["shows no stop"]
        for what, wrong in suspects.items():
            if steps := [str(1 + step) for step in wrong.nonzero().flatten().tolist()]:
                doubts.append(f"{what} at step {', '.join(steps)}")
        named = [actions[label] for label in labels[begin:end].tolist()]
        found.append(Recorded(number, sentences[number], named, sure[begin:end].tolist(), doubts))
    return sorted(found, key=lambda one: (-len(one.doubts), min(one.confidence, default=1.0)))


def _changes(demos: Demonstrations) -> Tensor:
    """Return the share of each transition's image that changes, float32 [M]."""
    frame, parts = demos.locate()[1], []
    for rows in frame.split(1024):
        differs = demos.codes[rows + 1] != demos.codes[rows]
        parts.append(differs.flatten(1).float().mean(1))
    return torch.cat(parts) if parts else torch.zeros(0)
