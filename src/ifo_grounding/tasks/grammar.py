"""Sentences of the five tasks: templates, a parser, and the zero-shot splits."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable

import torch
from torch import Tensor

from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.tasks.goals import SIDES, TASKS, Goal, check_task
from ifo_grounding.tasks.vocabulary import VOCABULARY, words_of
from ifo_grounding.world import BOX_COLOURS, N_KINDS, kind, kind_name

KINDS = ("", *(kind_name(number) for number in range(1, N_KINDS + 1)))
BOXES = ("", *BOX_COLOURS)
NAMES = {
    "object": KINDS,
    "reference": KINDS,
    "source": BOXES,
    "target": BOXES,
    "side": ("above", "to the right of", "below", "to the left of"),
}
"""What a sentence says of each field of a goal, by number."""
FIELDS = tuple(NAMES)


def _wordings(pattern: str, *choices: Iterable[str]) -> list[str]:
    """Return a pattern with each ``%s`` filled in, in all ways."""
    return [pattern % words for words in itertools.product(*choices)]


PUTS = ("put", "place", "drop")
INTO = ("in", "into")
VERBS = ("move", "bring", "carry", "transfer", "shift", "take")
TAKES = (
    *_wordings("%s the {object} out of", ("take", "get", "pick", "lift", "pull")),
    "remove the {object} from",
)
PHRASINGS = {
    "move": ["move to the {object}"],
    "move-udlr": ["move the arm {side} the {object}", "go to the cell {side} the {object}"],
    "pick": [
        *_wordings("%s the {object} %s the {target} box", PUTS, INTO),
        *_wordings("pick up the {object} and %s it %s the {target} box", PUTS, INTO),
    ],
    "pick-out": [
        *_wordings(
            "%s the {object} from the {source} box %s the {target} box",
            VERBS,
            ("to", "into", "inside"),
        ),
        *_wordings(
            "%s the {source} box and %s the {target} box",
            TAKES,
            ("put it into", "place it in", "drop it in"),
        ),
    ],
    "pick-udlr": [
        *_wordings("%s the {object} {side} the {reference}", PUTS),
        *_wordings("pick up the {object} and %s it {side} the {reference}", PUTS),
    ],
}
"""Wordings of each task; a udlr task has each of them for each side."""
N_TEMPLATES = {
    task: len(wordings) * (len(SIDES) if task.endswith("udlr") else 1)
    for task, wordings in PHRASINGS.items()
}
"""Templates of each task as the paper counts them, sides included."""

HOLDOUTS = {
    "pairs-1": ("yellow circle",),
    "pairs-2": ("yellow circle", "red triangle"),
    "pairs-3": ("yellow circle", "yellow rectangle", "red triangle"),
    "pairs-4": ("yellow circle", "yellow rectangle", "red triangle", "blue diamond"),
    "validation-3": ("blue circle", "blue triangle", "red rectangle"),
}
"""Colour-shape pairs that no training instruction mentions; each word stays in some other pair.

What is chosen is chosen on `validation-3`, whose pairs are none of the others'."""
SPLITS = ("all", "train", "zero-shot")


def holdout_kinds(holdout: str) -> tuple[int, ...]:
    """Return the object kinds of a named list of held-out pairs."""
    check_choice("holdout", holdout, HOLDOUTS)
    return tuple(kind(*name.split()) for name in HOLDOUTS[holdout])


def in_split(goal: Goal, split: str, holdout: str) -> Tensor:
    """Say which goals belong to a split, bool [*B].

    ``train`` mentions no held-out pair, ``zero-shot`` at least one, ``all`` is both.
    """
    check_choice("split", split, SPLITS)
    if split == "all":
        return torch.ones_like(goal.task, dtype=torch.bool)
    held_out = torch.tensor(holdout_kinds(holdout), device=goal.task.device)
    mentions = torch.isin(goal.object, held_out) | torch.isin(goal.reference, held_out)
    return mentions if split == "zero-shot" else ~mentions


class Grammar:
    """All sentences of a task, and the goal of each; use :func:`grammar` to get one.

    >>> moves = grammar("move")
    >>> moves.parse("move to the red circle").object.item()
    1
    >>> len(moves.sentences), len(grammar("pick-out").sentences)
    (12, 18144)
    """

    def __init__(self, task: str) -> None:
        self.task = check_task(task)
        self.phrasings = PHRASINGS[task]
        fields = _fields(self.phrasings[0])
        self.sentences = tuple(
            phrasing.format(**{name: NAMES[name][row[at]] for at, name in enumerate(FIELDS)})
            for row in fields
            for phrasing in self.phrasings
        )
        """Every sentence, goal by goal in all wordings."""
        table = torch.tensor(fields)
        columns = table.repeat_interleave(len(self.phrasings), 0).unbind(-1)
        tasks = torch.full_like(columns[0], self.task)
        self.goals = Goal(tasks, *columns, batch_size=tasks.shape)
        """The goal of each sentence, [S]."""
        self.tokens = VOCABULARY.encode(self.sentences)
        """Token ids of every sentence, int64 [S, 16]."""
        self._by_sentence = {sentence: row for row, sentence in enumerate(self.sentences)}
        self._goal_rows = torch.zeros([len(words) for words in NAMES.values()], dtype=torch.int64)
        self._goal_rows[tuple(table.unbind(-1))] = torch.arange(len(fields))

    def encode(self, goal: Goal, phrasing: Tensor) -> Tensor:
        """Return the tokens of goals of the task [*B] in some wordings [*B], int64 [*B, 16]."""
        device = phrasing.device
        rows = self._goal_rows.to(device)[tuple(getattr(goal, name) for name in FIELDS)]
        return self.tokens.to(device)[rows * len(self.phrasings) + phrasing]

    def parse(self, sentences: str | list[str]) -> Goal:
        """Return the goal of each sentence, [N].

        Raises:
            UserError: where a sentence is none of this task's.
        """
        if isinstance(sentences, str):
            sentences = [sentences]
        rows = [self._by_sentence.get(" ".join(words_of(sentence))) for sentence in sentences]
        if None in rows:
            raise UserError(
                f"{sentences[rows.index(None)]!r} is no sentence of {TASKS[self.task]}; "
                f"it says such as {self.sentences[0]!r}"
            )
        return self.goals[torch.tensor(rows, dtype=torch.int64)]

    def parse_tokens(self, tokens: Tensor) -> Goal:
        """Return the goal of each row of token ids [N, 16], [N] on the tokens' device."""
        distinct, inverse = tokens.cpu().unique(dim=0, return_inverse=True)
        return self.parse(VOCABULARY.decode(distinct))[inverse].to(tokens.device)


@functools.cache
def grammar(task: str) -> Grammar:
    """Return the grammar of a task."""
    return Grammar(task)


def _fields(phrasing: str) -> list[tuple[int, ...]]:
    """Return the fields of every goal that a wording can express."""
    numbers = [
        [number for number, word in enumerate(words) if word] if f"{{{name}}}" in phrasing else [0]
        for name, words in NAMES.items()
    ]
    return [
        (item, reference, source, target, side)
        for item, reference, source, target, side in itertools.product(*numbers)
        if item != reference and (source != target or not source)
    ]
