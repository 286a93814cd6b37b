"""Numbered scenes: every number is one fixed initial state, with a suitable goal where asked for.

A stream of scenes is a function of its seed and name, so that a scene can be drawn again by its
number, training and evaluation never meet, and results can name the scenes that they are about.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field

import torch
from tensordict import TensorClass
from torch import Tensor

from ifo_grounding.errors import UserError, check_choice
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
from ifo_grounding.world import Layout, WorldState, random_layout

CHUNK = 1024
"""Scenes that one generator draws."""
AHEAD = 4
"""Chunks that are drawn side by side, in some 0.6 times as long as one after another."""
BLOCK = AHEAD * CHUNK
BLOCKS_KEPT = 128
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
        """Refuse unknown names."""
        check_task(self.task)
        check_choice("split", self.split, SPLITS)
        check_choice("stream", self.stream, STREAMS)
        holdout_kinds(self.holdout)
        if self.max_steps < 1:
            raise UserError(f"max_steps must be positive, got {self.max_steps}")

    @property
    def shown_layout(self) -> Layout:
        """The layout, without held-out kinds where they must not be seen."""
        if self.holdout_visible or self.split != "train":
            return self.layout
        excluded = (*self.layout.excluded_kinds, *holdout_kinds(self.holdout))
        return Layout(**{**self.layout.__dict__, "excluded_kinds": excluded})


class SceneStream:
    """The scenes of one seed, by number.

    >>> stream = SceneStream(SceneOptions("pick"), seed=0)
    >>> scenes = stream.scenes(torch.tensor([5, 2000]))
    >>> scenes.instruction.shape, scenes.wanted.verdict.tolist()
    (torch.Size([2, 16]), [0, 0])
    """

    def __init__(
        self, options: SceneOptions, seed: int, device: torch.device | str | None = None
    ) -> None:
        self.options, self.seed = options, seed
        self.device = torch.device(device or "cpu")
        self._block = functools.lru_cache(maxsize=BLOCKS_KEPT)(self._draw_block)

    def scenes(self, numbers: Tensor) -> Scene:
        """Return the scenes with the given numbers, int64 [N]."""
        if numbers.numel() and int(numbers.min()) < 0:
            raise UserError("scene numbers start at 0")
        blocks = (numbers // BLOCK).tolist()
        distinct = sorted(set(blocks)) or [0]
        if len(distinct) == 1:
            return self._block(distinct[0])[numbers % BLOCK]
        first_row = {block: BLOCK * place for place, block in enumerate(distinct)}
        start = torch.tensor([first_row[block] for block in blocks], device=numbers.device)
        return _cat([self._block(block) for block in distinct])[start + numbers % BLOCK]

    def _draw_block(self, block: int) -> Scene:
        """Draw the scenes of several chunks on the CPU, so that every device gets the same ones."""
        options = self.options
        numbers = range(block * AHEAD, (block + 1) * AHEAD)
        draws = [generator(self.seed, "scenes", options.stream, number) for number in numbers]
        missing = torch.full((AHEAD,), CHUNK)
        kept: list[Scene] = []
        owners: list[Tensor] = []
        for _ in range(PATIENCE):
            unfinished = missing.nonzero().squeeze(-1)
            scenes = self._propose([draws[chunk] for chunk in unfinished])
            good = torch.ones(len(unfinished), CHUNK, dtype=torch.bool)
            if options.instructed:
                good = (scenes.wanted.verdict == SUITABLE).view_as(good)
            good &= good.cumsum(1) <= missing[unfinished].unsqueeze(1)
            missing[unfinished] -= good.sum(1)
            kept.append(scenes[good.flatten()])
            owners.append(unfinished.repeat_interleave(good.sum(1)))
            if not missing.any():
                order = torch.cat(owners).argsort(stable=True)
                return _cat(kept)[order].to(self.device)
        raise UserError(
            f"after {PATIENCE * CHUNK} draws only {CHUNK - int(missing.max())} scenes admit a "
            f"suitable goal of {options.task!r} in split {options.split!r} within "
            f"{options.max_steps} steps: give the layout more objects or boxes, or episodes more "
            "steps"
        )

    def _propose(self, draws: list[torch.Generator]) -> Scene:
        """Draw a chunk of scenes with each generator, suitable or not."""
        options, n = self.options, CHUNK * len(draws)
        state = random_layout(n, options.shown_layout, generator=draws)
        goal = propose_goal(state, check_task(options.task), draws)
        wanted = plan(state, goal, options.max_steps)
        listed = in_split(goal, options.split, options.holdout)
        wanted.verdict = torch.where(listed, wanted.verdict, -1)
        sentences = grammar(options.task)
        said = torch.zeros(n, sentences.tokens.shape[-1], dtype=torch.int64)
        wordings = _integers(len(sentences.phrasings), n, draws)
        accepted = wanted.verdict == SUITABLE
        said[accepted] = sentences.encode(goal[accepted], wordings[accepted])
        return Scene(state=state, wanted=wanted, instruction=said, batch_size=[n])


def _integers(high: int, n: int, source: Generators) -> Tensor:
    return draw_rows(lambda n, draw: torch.randint(high, (n,), generator=draw), n, source)


def _cat(scenes: list[Scene]) -> Scene:
    return torch.cat(scenes)  # type: ignore[arg-type, return-value]


def propose_goal(state: WorldState, task: int, source: Generators) -> Goal:
    """Draw a goal about things that are in states [N]; it need not be suitable."""
    shape = state.arm.shape

    def pick(mask: Tensor) -> Tensor:
        """Draw one true cell of each row."""
        drawn = draw_rows(
            lambda n, draw: torch.rand(n, *mask.shape[1:], generator=draw), len(mask), source
        )
        return (drawn * mask).argmax(-1, keepdim=True)

    def at(cells: Tensor, values: Tensor) -> Tensor:
        return values.gather(-1, cells).squeeze(-1).long()

    nothing = torch.zeros(shape, dtype=torch.int64)
    exists = state.objects > 0
    candidates = exists & (state.boxes > 0) if task == PICK_OUT else exists
    cell = pick(candidates)
    others = state.objects.scatter(-1, cell, 0)
    other = pick(others > 0)
    has_box = state.boxes > 0
    return Goal(
        task=torch.full(shape, task),
        object=at(cell, state.objects),
        reference=at(other, others) if task == PICK_UDLR else nothing,
        source=at(cell, state.boxes) if task == PICK_OUT else nothing,
        target=at(pick(has_box), state.boxes) if task in (PICK, PICK_OUT) else nothing,
        side=_integers(4, len(state.arm), source) if task in (MOVE_UDLR, PICK_UDLR) else nothing,
        batch_size=shape,
    )
