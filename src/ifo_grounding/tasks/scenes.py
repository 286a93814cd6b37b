"""Scenes: initial states, each with a suitable goal where asked for, and how blocks are drawn."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import torch
from tensordict import TensorClass
from torch import Tensor

from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.seeding import STREAMS, Generators, draw_rows, generator
from ifo_grounding.tasks.goals import (
    MAX_STEPS,
    MOVE_UDLR,
    PICK,
    PICK_OUT,
    PICK_UDLR,
    SUITABLE,
    Goal,
    Plan,
    check_task,
    plan,
)
from ifo_grounding.tasks.grammar import SPLITS, grammar, holdout_kinds, in_split
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.world import Layout, WorldState, random_layout

CHUNK = 1024
"""Scenes that one generator draws."""
AHEAD = 8
"""Chunks that are drawn side by side, in half as long as one after another."""
ROUNDS_HELD = 8
"""Rounds of draws after which what was refused is let go of, for memory's sake."""
PATIENCE = 1000
"""Draws of a chunk after which a layout counts as unable to hold a suitable goal."""


class Scene(TensorClass):
    """Initial states with what is asked there."""

    state: WorldState
    """Initial state, [*B]."""
    wanted: Plan
    """The goal resolved in it, [*B]."""
    instruction: Tensor
    """Tokens of a sentence for the goal, int64 [*B, 16]."""

    @classmethod
    def unasked(cls, state: WorldState) -> Scene:
        """Return scenes [N] in which nothing is asked: a plan and words of zeros."""
        nothing = torch.zeros_like(state.arm)
        wanted = Plan(
            verdict=nothing.clone(),
            object_cell=nothing.clone(),
            destination=nothing.clone(),
            carries=nothing.bool(),
            objects=torch.zeros_like(state.objects),
            steps=nothing.clone(),
            batch_size=state.batch_size,
        )
        words = nothing.new_zeros(*state.batch_size, VOCABULARY.length)
        return cls(state=state, wanted=wanted, instruction=words, batch_size=state.batch_size)


@dataclass(frozen=True)
class SceneOptions:
    """Which scenes a stream holds."""

    task: str = "move"
    """One of the five tasks."""
    instructed: bool = True
    """Whether each scene has a suitable goal; else goals are absent and scenes unconditioned."""
    split: str = "all"
    """``all``, ``train`` or ``zero-shot``."""
    holdout: str = "pairs-3"
    """Named list of colour-shape pairs that training instructions do not mention."""
    holdout_visible: bool = True
    """Whether held-out pairs are still seen in the scenes of the split ``train``."""
    stream: str = "training"
    """``training``, ``validation`` or ``evaluation``: disjoint scenes."""
    layout: Layout = field(default_factory=Layout)
    """Grid size and counts."""
    max_steps: int = MAX_STEPS
    """Actions per episode; a goal that needs more is unachievable."""

    def __post_init__(self) -> None:
        """Refuse unknown names."""
        check_task(self.task)
        if not isinstance(self.layout, Layout):
            raise UserError(
                f"a layout is a Layout, such as Layout(size=8), got {type(self.layout).__name__}"
            )
        check_choice("split", self.split, SPLITS)
        check_choice("stream", self.stream, STREAMS)
        holdout_kinds(self.holdout)
        at_least_one("max_steps", self.max_steps)

    @property
    def shown_layout(self) -> Layout:
        """The layout, without held-out kinds where they must not be seen."""
        if self.holdout_visible or self.split != "train":
            return self.layout
        excluded = (*self.layout.excluded_kinds, *holdout_kinds(self.holdout))
        return Layout(**{**self.layout.__dict__, "excluded_kinds": excluded})


STATE_LEAVES = tuple(each.name for each in fields(WorldState))
PLAN_LEAVES = tuple(each.name for each in fields(Plan))


def draw_block(options: SceneOptions, seed: int, block: int) -> Scene:
    """Draw the scenes of several chunks on the CPU, so that every device gets the same ones.

    Raises:
        UserError: where hardly any scene has a suitable goal.
    """
    numbers = range(block * AHEAD, (block + 1) * AHEAD)
    draws = [generator(seed, "scenes", options.stream, number) for number in numbers]
    missing = torch.full((AHEAD,), CHUNK)
    proposed: list[_Proposal] = []
    rows: list[Tensor] = []
    owners: list[Tensor] = []
    for _ in range(PATIENCE):
        unfinished = missing.nonzero().squeeze(-1)
        sources = [draws[chunk] for chunk in unfinished]
        proposal, good = _propose(options, sources)
        good &= good.cumsum(1) <= missing[unfinished].unsqueeze(1)
        missing[unfinished] -= good.sum(1)
        before = sum(len(each.wording) for each in proposed)
        owner, place = good.nonzero(as_tuple=True)
        rows.append(before + owner * CHUNK + place)
        proposed.append(proposal)
        owners.append(unfinished[owner])
        if not missing.any():
            order = torch.cat(owners).argsort(stable=True)
            found = _chosen(proposed, torch.cat(rows)[order])
            return _said(found, options.task) if options.instructed else Scene.unasked(found.state)
        if len(proposed) == ROUNDS_HELD:
            proposed = [_chosen(proposed, torch.cat(rows))]
            rows = [torch.arange(len(proposed[0].wording))]
    raise UserError(
        f"after {PATIENCE * CHUNK} draws only {CHUNK - int(missing.max())} scenes admit a "
        f"suitable goal of {options.task!r} in split {options.split!r} within "
        f"{options.max_steps} steps: give the layout more objects or boxes, or episodes more "
        "steps"
    )


def _propose(options: SceneOptions, draws: list[torch.Generator]) -> tuple[_Proposal, Tensor]:
    """Draw a chunk of scenes with each of G generators, and say which are suitable, [G, CHUNK]."""
    n = CHUNK * len(draws)
    state = random_layout(n, options.shown_layout, generator=draws)
    goal = propose_goal(state, check_task(options.task), draws)
    wanted = plan(state, goal, options.max_steps)
    if options.split != "all":
        listed = in_split(goal, options.split, options.holdout)
        wanted.verdict = torch.where(listed, wanted.verdict, -1)
    wording = _integers(len(grammar(options.task).phrasings), n, draws)
    good = wanted.verdict == SUITABLE
    if not options.instructed:
        good = torch.ones_like(good)
    return _Proposal(state, wanted, goal, wording), good.view(len(draws), CHUNK)


class _Proposal(NamedTuple):
    """Scenes, and what might be said there."""

    state: WorldState
    wanted: Plan
    goal: Goal
    wording: Tensor


def _chosen(proposed: list[_Proposal], rows: Tensor) -> _Proposal:
    """Return some scenes of several proposals, numbered one after the other."""
    parts: list[Any] = [torch.cat(part)[rows] for part in zip(*proposed, strict=True)]
    return _Proposal(*parts)


def _said(proposal: _Proposal, task: str) -> Scene:
    """Return scenes with a sentence for each goal."""
    state, wanted, goal, wording = proposal
    said = grammar(task).encode(goal, wording)
    return Scene(state=state, wanted=wanted, instruction=said, batch_size=[len(wording)])


def _integers(high: int, n: int, source: Generators) -> Tensor:
    return draw_rows(lambda n, draw: torch.randint(high, (n,), generator=draw), n, source)


def state_leaves(state: WorldState) -> list[Tensor]:
    """Return what worlds are made of, always in the same order."""
    return [getattr(state, each) for each in STATE_LEAVES]


def plan_leaves(wanted: Plan) -> list[Tensor]:
    """Return what plans are made of, always in the same order."""
    return [getattr(wanted, each) for each in PLAN_LEAVES]


def scene_leaves(scenes: Scene) -> list[Tensor]:
    """Return what scenes are made of, always in the same order."""
    return [*state_leaves(scenes.state), *plan_leaves(scenes.wanted), scenes.instruction]


def propose_goal(state: WorldState, task: int, source: Generators) -> Goal:
    """Draw a goal about things that are in states [N]; it need not be suitable."""
    shape = state.arm.shape

    def drawn() -> Tensor:
        return draw_rows(
            lambda n, draw: torch.rand(
                n, state.objects.shape[-1], generator=draw, dtype=torch.float32
            ),
            len(state.arm),
            source,
        )

    def pick(mask: Tensor) -> Tensor:
        """Draw one true cell of each row."""
        return (drawn() * mask).argmax(-1, keepdim=True)

    def at(cells: Tensor, values: Tensor) -> Tensor:
        return values.gather(-1, cells).squeeze(-1).long()

    nothing = torch.zeros(shape, dtype=torch.int64)
    exists = state.objects > 0
    candidates = exists & (state.boxes > 0) if task == PICK_OUT else exists
    cell = pick(candidates)
    reference = nothing
    if task == PICK_UDLR:
        others = state.objects.scatter(-1, cell, 0)
        reference = at(pick(others > 0), others)
    else:
        drawn()  # as of every task, so that scenes stay what they are
    has_box = state.boxes > 0
    return Goal(
        task=torch.full(shape, task),
        object=at(cell, state.objects),
        reference=reference,
        source=at(cell, state.boxes) if task == PICK_OUT else nothing,
        target=at(pick(has_box), state.boxes) if task in (PICK, PICK_OUT) else nothing,
        side=_integers(4, len(state.arm), source) if task in (MOVE_UDLR, PICK_UDLR) else nothing,
        batch_size=shape,
    )
