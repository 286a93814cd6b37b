"""Case studies: chosen instructions, and episodes that only phase 2 solves (Fig. 5 and 6)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ifo_grounding.errors import UserError
from ifo_grounding.evaluation.suitability import NOT_SERVED, checked_choices, read_pool
from ifo_grounding.report.drawing import Cell, draw_sheet
from ifo_grounding.report.theme import BAD, GOOD
from ifo_grounding.tasks.goals import REASONS
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.world import render

PICTURE_TILE_SIZE = 32
"""Pixels along one side of a cell in the pictures of cases."""


@dataclass(frozen=True)
class Case:
    """A picture, a sentence and a verdict."""

    picture: np.ndarray
    """Pixels, uint8 [3, H, W]."""
    sentence: str
    """The instruction."""
    good: bool
    """Whether it is suitable."""
    note: str
    """What the oracle says of it, and the probability that the classifier gave to it."""


def instruction_cases(
    classifier: TensorDictModuleBase,
    task: str,
    pool: Tensor | Sequence[str],
    *,
    count: int = 12,
    unsuitable: int | None = None,
    search: int = 512,
    **options: Any,
) -> list[Case]:
    """Return instructions that a classifier chose, with the oracle's verdicts: the suitable first.

    Unsuitable choices are what there is to learn from, so they are shown beyond their share.

    Args:
        classifier: TensorDictModule from (pixels, instruction) to the logit of suitability.
        task: name of the task.
        pool: the instructions to choose from.
        count: how many cases at most.
        unsuitable: how many of them may be unsuitable; a third by default.
        search: states among which to look for cases.
        options: of :func:`~ifo_grounding.evaluation.suitable_rate`, such as ``threshold``.
    """
    judged = checked_choices(classifier, task, pool, states=search, **options)
    tokens, _ = read_pool(task, pool)
    wrong = (judged.verdict > 0).nonzero().squeeze(-1).tolist()
    right = (judged.verdict == 0).nonzero().squeeze(-1).tolist()
    wrong = wrong[: count // 3 if unsuitable is None else unsuitable]
    rows = [*right[: count - len(wrong)], *wrong]
    assert not any(judged.verdict[row] == NOT_SERVED for row in rows)
    if not rows:
        return []
    pictures = render(judged.state[torch.tensor(rows)], PICTURE_TILE_SIZE).cpu().numpy()
    sentences = VOCABULARY.decode(tokens[judged.chosen[rows].cpu()])
    return [
        Case(
            picture=picture,
            sentence=sentence,
            good=not judged.verdict[row],
            note=f"{REASONS[int(judged.verdict[row])]} ({float(judged.score[row]):.2f})",
        )
        for row, picture, sentence in zip(rows, pictures, sentences, strict=True)
    ]


def gallery(cases: Sequence[Case], *, columns: int = 4, width: int = 200) -> bytes:
    """Return cases side by side as a PNG.

    >>> case = Case(np.zeros((3, 48, 48), dtype=np.uint8), "move to the red circle", True, "fits")
    >>> gallery([case])[1:4]
    b'PNG'
    """
    if not cases:
        raise UserError("a gallery needs at least one case")
    cells = [
        Cell(case.picture, case.sentence, note=case.note, colour=GOOD if case.good else BAD)
        for case in cases
    ]
    buffer = io.BytesIO()
    draw_sheet(cells, columns=columns, width=width).save(buffer, format="PNG")
    return buffer.getvalue()
