"""Scenes: initial states, each with a suitable goal where asked for, by number."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from tensordict import TensorClass
from torch import Tensor

from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.seeding import STREAMS, Lots, derive
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

PATIENCE = 1000
"""Draws for each scene after which a layout counts as unable to hold a suitable goal."""
FEWEST = 1024
"""Scenes that are drawn at once at least: fewer take as long."""


class Scene(TensorClass):
    """Initial states with what is asked there."""

    state: WorldState
    """Initial state, [*B]."""
    wanted: Plan
    """The goal resolved in it, [*B]."""
    instruction: Tensor
    """Tokens of a sentence for the goal, int64 [*B, 16]."""

    @classmethod
    def of(cls, leaves: list[Tensor]) -> Scene:
        """Return the scenes [N] whose :func:`leaves` are given."""
        parts, shape = iter(leaves), leaves[0].shape
        made = [
            kind(**{each.name: next(parts) for each in fields(kind)}, batch_size=shape)
            for kind in (WorldState, Plan)
        ]
        return cls(*made, next(parts), batch_size=shape)


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
        for name in ("instructed", "holdout_visible"):
            check_choice(name, getattr(self, name), (True, False))
        if not isinstance(self.layout, Layout):
            raise UserError(
                f"a layout is a Layout, such as Layout(size=8), got {type(self.layout).__name__}"
            )
        check_choice("split", self.split, SPLITS)
        check_choice("stream", self.stream, STREAMS)
        holdout_kinds(self.holdout)
        object.__setattr__(self, "max_steps", at_least_one("max_steps", self.max_steps))

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


@torch.inference_mode(False)
def draw_scenes(options: SceneOptions, seed: int, numbers: Tensor) -> Scene:
    """Draw the scenes with the given numbers, int64 [N], where the numbers lie.

    A scene is the first draw of its number that has a suitable goal; without instructions the
    first of all. It depends on nothing else, and is the same on every device.

    Raises:
        UserError: where hardly any scene has a suitable goal.

    >>> scenes = draw_scenes(SceneOptions("pick"), 0, torch.tensor([5, 2000]))
    >>> scenes.instruction.shape, scenes.wanted.verdict.tolist()
    (torch.Size([2, 16]), [0, 0])
    """
    key = derive(seed, "scenes", options.stream)
    if not options.instructed:
        lots = Lots(key, numbers, torch.zeros_like(numbers))
        return _unasked(random_layout(lots, options.shown_layout))
    left = torch.arange(len(numbers), device=numbers.device)
    width = max(len(left), FEWEST)
    found: list[Any] = []
    places: list[Tensor] = []
    times, tried, drawn = 1, 0, 0
    while not found or len(left):
        if drawn >= PATIENCE * width:
            raise UserError(
                f"after {drawn} draws only {len(numbers) - len(left)} of {len(numbers)} scenes "
                f"admit a suitable goal of {options.task!r} in split {options.split!r} within "
                f"{options.max_steps} steps: give the layout more objects or boxes, or episodes "
                "more steps"
            )
        draws = torch.arange(tried, tried + times, device=left.device).repeat(len(left))
        lots = Lots(key, numbers[left].repeat_interleave(times), draws)
        proposal, good = _propose(options, lots)
        has, first = good.view(len(left), times).max(1)
        found.append(proposal[(torch.arange(len(left), device=left.device) * times + first)[has]])
        places.append(left[has])
        left, tried, drawn = left[~has], tried + times, drawn + len(lots)
        if len(left):  # few passes, and few draws in vain
            enough = max(2 * times, width // 4 // len(left))
            times = min(enough, 2 * width // len(left))
    every: Any = torch.cat(found)
    every = every[torch.cat(places).argsort()]
    said = grammar(options.task).encode(every.goal, every.wording)
    return Scene(every.state, every.wanted, said, batch_size=every.batch_size)


def _unasked(state: WorldState) -> Scene:
    """Return scenes in which nothing is asked: plans and words of zeros."""
    nothing, shape = torch.zeros_like(state.arm), state.batch_size
    cells, words = torch.zeros_like(state.objects), nothing.new_zeros(*shape, VOCABULARY.length)
    wanted = Plan(nothing, nothing, nothing, nothing.bool(), cells, nothing, batch_size=shape)
    return Scene(state, wanted, words, batch_size=shape)


def _propose(options: SceneOptions, lots: Lots) -> tuple[_Proposal, Tensor]:
    """Draw scenes [N], and say which are suitable, bool [N]."""
    state = random_layout(lots, options.shown_layout)
    goal = propose_goal(state, check_task(options.task), lots)
    wanted = plan(state, goal, options.max_steps)
    good = (wanted.verdict == SUITABLE) & in_split(goal, options.split, options.holdout)
    wording = lots.below(len(grammar(options.task).phrasings)).squeeze(-1)
    return _Proposal(state, wanted, goal, wording, batch_size=[len(lots)]), good


def leaves(whole: WorldState | Plan | Scene) -> list[Tensor]:
    """Return what worlds, plans or scenes are made of, always in the same order."""
    found: list[Tensor] = []
    for each in fields(whole):
        part = getattr(whole, each.name)
        found += [part] if isinstance(part, Tensor) else leaves(part)
    return found


def propose_goal(state: WorldState, task: int, lots: Lots) -> Goal:
    """Draw a goal about things that are in states [N]; it need not be suitable."""

    def pick(mask: Tensor) -> Tensor:
        """Draw one true cell of each row, [N, 1]; the first cell where none is true."""
        order = mask.cumsum(-1, dtype=torch.int16)
        return (order > lots.below(order[:, -1:].long())).byte().argmax(-1, keepdim=True)

    def at(cells: Tensor, values: Tensor) -> Tensor:
        return values.gather(-1, cells).squeeze(-1).long()

    objects, boxes = state.objects > 0, state.boxes > 0
    cell = pick(objects & boxes if task == PICK_OUT else objects)
    reference = target = side = nothing = torch.zeros_like(state.arm)
    if task == PICK_UDLR:
        others = state.objects.scatter(-1, cell, 0)
        reference = at(pick(others > 0), others)
    if task in (PICK, PICK_OUT):
        target = at(pick(boxes), state.boxes)
    if task in (MOVE_UDLR, PICK_UDLR):
        side = lots.below(4).squeeze(-1)
    return Goal(
        task=torch.full_like(nothing, task),
        object=at(cell, state.objects),
        reference=reference,
        source=at(cell, state.boxes) if task == PICK_OUT else nothing,
        target=target,
        side=side,
        batch_size=nothing.shape,
    )
