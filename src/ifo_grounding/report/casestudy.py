"""Case studies: instructions that a classifier chose, with what the oracle says (Fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ifo_grounding.evaluation.suitability import read_pool, suitable_rate
from ifo_grounding.report.drawing import Captioned
from ifo_grounding.report.theme import BAD, GOOD
from ifo_grounding.tasks.goals import REASONS
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.world import render


def instruction_cases(
    classifier: TensorDictModuleBase,
    task: str,
    pool: Tensor | Sequence[str],
    *,
    count: int = 12,
    **options: Any,
) -> list[Captioned]:
    """Return instructions that a classifier chose, with the oracle's verdicts: the suitable first.

    Unsuitable choices are what there is to learn from: they are up to a third of the cases.

    Args:
        classifier: TensorDictModule from (pixels, instruction) to the logit of suitability.
        task: name of the task.
        pool: the instructions to choose from.
        count: how many cases at most.
        options: of :func:`~ifo_grounding.evaluation.suitable_rate`, such as ``threshold``.
    """
    found = suitable_rate(classifier, task, pool, states=512, pairs_per_state=0, **options)
    tokens, _ = read_pool(task, pool)
    wrong = (found.verdict > 0).nonzero().squeeze(-1).tolist()[: count // 3]
    right = (found.verdict == 0).nonzero().squeeze(-1).tolist()[: count - len(wrong)]
    rows = torch.tensor([*right, *wrong], dtype=torch.int64)
    if not len(rows):
        return []
    pictures = render(found.state[rows], tile_size=32).numpy()
    sentences = VOCABULARY.decode(tokens[found.chosen[rows]])
    cases = []
    for row, picture, sentence in zip(rows.tolist(), pictures, sentences, strict=True):
        verdict = int(found.verdict[row])
        note = f"{REASONS[verdict]} ({float(found.score[row]):.2f})"
        cases.append(Captioned(picture, sentence, note=note, colour=BAD if verdict else GOOD))
    return cases
