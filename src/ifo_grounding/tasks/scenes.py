"""Scenes: initial states, each with a suitable goal where asked for, and how blocks are drawn."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

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
        return replace(self.layout, excluded_kinds=excluded)


class _Proposal(TensorClass):
    """Scenes, and what might be said there."""

    state: WorldState
    wanted: Plan
    goal: Goal
    wording: Tensor


def draw_block(options: SceneOptions, seed: int, block: int) -> Scene:
    """Draw the scenes of several chunks on the CPU, so that every device gets the same ones.

    Raises:
        UserError: where hardly any scene has a suitable goal.
    """
    numbers = range(block * AHEAD, (block + 1) * AHEAD)
    draws = [generator(seed, "scenes", options.stream, number) for number in numbers]
    missing = torch.full((AHEAD,), CHUNK)
    kept: list[Any] = []
    owners: list[Tensor] = []
    for _ in range(PATIENCE):
        unfinished = missing.nonzero().squeeze(-1)
        proposal, good = _propose(options, [draws[chunk] for chunk in unfinished])
        good &= good.cumsum(1) <= missing[unfinished].unsqueeze(1)
        missing[unfinished] -= good.sum(1)
        kept.append(proposal[good.flatten()])
        owners.append(unfinished.repeat_interleave(good.sum(1)))
        if not missing.any():
            found: Any = torch.cat(kept)
            return _said(found[torch.cat(owners).argsort(stable=True)], options)
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
    good = (wanted.verdict == SUITABLE) & in_split(goal, options.split, options.holdout)
    if not options.instructed:
        good = torch.ones_like(good)
    wording = _integers(len(grammar(options.task).phrasings), n, draws)
    return _Proposal(state, wanted, goal, wording, batch_size=[n]), good.view(len(draws), CHUNK)


def _said(found: _Proposal, options: SceneOptions) -> Scene:
    """Return scenes with a sentence for each goal, or with a plan and words of zeros."""
    wanted: Any = found.wanted
    if options.instructed:
        said = grammar(options.task).encode(found.goal, found.wording)
    else:
        wanted = torch.zeros_like(wanted)
        said = torch.zeros(len(found), VOCABULARY.length, dtype=torch.int64)
    return Scene(found.state, wanted, said, batch_size=found.batch_size)


def _integers(high: int, n: int, source: Generators) -> Tensor:
    return draw_rows(partial(torch.randint, high), (n,), source)


def leaves(whole: WorldState | Plan | Scene) -> list[Tensor]:
    """Return what worlds, plans or scenes are made of, always in the same order."""
    found: list[Tensor] = []
    for each in fields(whole):
        part = getattr(whole, each.name)
        found += [part] if isinstance(part, Tensor) else leaves(part)
    return found


def propose_goal(state: WorldState, task: int, source: Generators) -> Goal:
    """Draw a goal about things that are in states [N]; it need not be suitable."""
    shape = state.arm.shape

    def drawn() -> Tensor:
        return draw_rows(torch.rand, state.objects.shape, source, dtype=torch.float32)

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
