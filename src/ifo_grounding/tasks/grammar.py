"""Sentences of the five tasks: templates, a parser, and the zero-shot splits."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator

import torch
from torch import Tensor

from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.tasks.goals import (
    MOVE_UDLR,
    PICK,
    PICK_OUT,
    PICK_UDLR,
    SIDES,
    TASKS,
    Goal,
    check_task,
)
from ifo_grounding.tasks.vocabulary import VOCABULARY, words_of
from ifo_grounding.world import BOX_COLOURS, N_BOXES, N_KINDS, kind, kind_name

SIDE_WORDS = {
    "above": "above",
    "right": "to the right of",
    "below": "below",
    "left": "to the left of",
}
PUTS = ("put", "place", "drop")
FIELDS = ("object", "reference", "source", "target", "side")


def _phrasings(task: str) -> tuple[str, ...]:
    if task == "move":
        return ("move to the {object}",)
    if task == "move-udlr":
        return ("move the arm {side} the {object}", "go to the cell {side} the {object}")
    if task == "pick":
        direct = [
            f"{verb} the {{object}} {into} the {{target}} box"
            for verb, into in itertools.product(PUTS, ("in", "into"))
        ]
        staged = [
            f"pick up the {{object}} and {verb} it {into} the {{target}} box"
            for verb, into in itertools.product(PUTS, ("in", "into"))
        ]
        return (*direct, *staged)
    if task == "pick-out":
        verbs = ("move", "bring", "carry", "transfer", "shift", "take")
        direct = [
            f"{verb} the {{object}} from the {{source}} box {into} the {{target}} box"
            for verb, into in itertools.product(verbs, ("to", "into", "inside"))
        ]
        staged = [
            f"{take} the {{object}} {'from' if take == 'remove' else 'out of'} the {{source}} box "
            f"and {put} the {{target}} box"
            for take, put in itertools.product(
                ("take", "get", "pick", "lift", "pull", "remove"),
                ("put it into", "place it in", "drop it in"),
            )
        ]
        return (*direct, *staged)
    direct = [f"{verb} the {{object}} {{side}} the {{reference}}" for verb in PUTS]
    staged = [f"pick up the {{object}} and {verb} it {{side}} the {{reference}}" for verb in PUTS]
    return (*direct, *staged)


PHRASINGS = {task: _phrasings(task) for task in TASKS}
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
        fields = list(_fillers(self.task))
        table = torch.tensor(fields)
        self.sentences = tuple(
            _fill(phrasing, row) for row in fields for phrasing in self.phrasings
        )
        """Every sentence, goal by goal in all wordings."""
        columns = table.repeat_interleave(len(self.phrasings), 0).unbind(-1)
        task_column = torch.full_like(columns[0], self.task)
        self.goals = Goal(
            task=task_column,
            **dict(zip(FIELDS, columns, strict=True)),
            batch_size=task_column.shape,
        )
        """The goal of each sentence, [S]."""
        self.tokens = VOCABULARY.encode(self.sentences)
        """Token ids of every sentence, int64 [S, 16]."""
        self._by_sentence = {sentence: row for row, sentence in enumerate(self.sentences)}
        self._goal_rows = torch.full((N_KINDS + 1, N_KINDS + 1, N_BOXES + 1, N_BOXES + 1, 4), -1)
        self._goal_rows[tuple(table.unbind(-1))] = torch.arange(len(fields))

    def encode(self, goal: Goal, phrasing: Tensor) -> Tensor:
        """Return the tokens of goals [*B] in the given wordings [*B], int64 [*B, 16]."""
        if ((phrasing < 0) | (phrasing >= len(self.phrasings))).any():
            raise UserError(
                f"wordings of {TASKS[self.task]} have the numbers 0..{len(self.phrasings) - 1}"
            )
        index = tuple(getattr(goal, name).cpu() for name in FIELDS)
        rows = self._goal_rows[index]
        if (rows < 0).any():
            raise UserError(f"no sentence of {TASKS[self.task]} expresses such a goal")
        tokens = self.tokens[rows * len(self.phrasings) + phrasing.cpu()]
        return tokens.to(goal.task.device)

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


def _fillers(task: int) -> Iterator[tuple[int, ...]]:
    """Yield the fields of every goal of a task that a sentence can express."""
    kinds, boxes = range(1, N_KINDS + 1), range(1, N_BOXES + 1)
    sides = range(len(SIDES))
    for item in kinds:
        if task == MOVE_UDLR:
            yield from ((item, 0, 0, 0, side) for side in sides)
        elif task == PICK:
            yield from ((item, 0, 0, box, 0) for box in boxes)
        elif task == PICK_OUT:
            yield from ((item, 0, *pair, 0) for pair in itertools.permutations(boxes, 2))
        elif task == PICK_UDLR:
            others = (other for other in kinds if other != item)
            yield from ((item, other, 0, 0, side) for other in others for side in sides)
        else:
            yield (item, 0, 0, 0, 0)


def _fill(phrasing: str, fields: tuple[int, ...]) -> str:
    item, reference, source, target, side = fields
    return phrasing.format(
        object=kind_name(item),
        reference=kind_name(reference) if reference else "",
        source=BOX_COLOURS[source - 1],
        target=BOX_COLOURS[target - 1],
        side=SIDE_WORDS[SIDES[side]],
    )
