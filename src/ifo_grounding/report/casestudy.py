"""Case studies: instructions that a classifier chose, with what the oracle says (Fig. 5)."""

from __future__ import annotations

import torch
from torch import Tensor

from ifo_grounding.evaluation import SuitabilityResult
from ifo_grounding.report.drawing import Captioned
from ifo_grounding.report.theme import BAD, GOOD
from ifo_grounding.tasks.goals import REASONS
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.world import render


def instruction_cases(
    found: SuitabilityResult, pool: Tensor, *, count: int = 12
) -> list[Captioned]:
    """Return instructions that a classifier chose, with the oracle's verdicts: the suitable first.

    Unsuitable choices are what there is to learn from: they are up to a third of the cases.

    Args:
        found: what :func:`~ifo_grounding.evaluation.suitable_rate` returned of the pool.
        pool: token ids of the instructions that it chose from, int64 [N, 16].
    """
    wrong = (found.verdict > 0).nonzero().squeeze(-1).tolist()[: count // 3]
    right = (found.verdict == 0).nonzero().squeeze(-1).tolist()[: count - len(wrong)]
    rows = torch.tensor([*right, *wrong], dtype=torch.int64)
    if not len(rows):
        return []
    pictures = render(found.state[rows], tile_size=32).numpy()
    sentences = VOCABULARY.decode(pool[found.chosen[rows]])
    cases = []
    for row, picture, sentence in zip(rows.tolist(), pictures, sentences, strict=True):
        verdict = int(found.verdict[row])
        note = f"{REASONS[verdict]} ({float(found.score[row]):.2f})"
        cases.append(Captioned(picture, sentence, note=note, colour=BAD if verdict else GOOD))
    return cases
