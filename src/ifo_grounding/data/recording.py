"""Recording an expert of the simulated world, tile numbers only."""

from __future__ import annotations

from typing import Any, Literal, overload

import torch
from torch import Tensor

from ifo_grounding.data.codec import FrameCodec
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.truth import Truth
from ifo_grounding.errors import at_least_one, check_choice
from ifo_grounding.progress import progress_bar
from ifo_grounding.seeding import derive, generator
from ifo_grounding.tasks import expert
from ifo_grounding.tasks.scenes import Scene, SceneOptions, draw_scenes
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.world import step
from ifo_grounding.world.tiles import TILE_SIZES, tile_index, tile_table

BATCH = 4096


@overload
def record_demonstrations(
    task: str, n: int, *, keep_truth: Literal[False] = ..., **options: Any
) -> Demonstrations: ...
@overload
def record_demonstrations(
    task: str, n: int, *, keep_truth: Literal[True], **options: Any
) -> tuple[Demonstrations, Truth]: ...
def record_demonstrations(
    task: str,
    n: int,
    *,
    keep_truth: bool = False,
    seed: int = 0,
    tile_size: int = 8,
    progress: bool = False,
    **scenes: Any,
) -> Demonstrations | tuple[Demonstrations, Truth]:
    """Record an expert that follows suitable instructions on shortest paths, and then stops.

    The scenes are none of those that an environment of the same seed shows.

    Args:
        task: ``move``, ``move-udlr``, ``pick``, ``pick-out`` or ``pick-udlr``.
        keep_truth: whether to return the actions too, for evaluation only.
        tile_size: pixels along one side of a cell: 8, 16 or 32.
        scenes: for :class:`~ifo_grounding.tasks.scenes.SceneOptions`: ``split``, ``holdout``,
            ``holdout_visible``, ``stream``, ``layout``, ``max_steps``.

    >>> demos = record_demonstrations("pick-out", 20, seed=0)
    >>> demos
    Demonstrations(20 episodes, ... frames, FrameCodec(3x48x48, ... tiles of 8))
    """
    check_choice("tile size", tile_size, TILE_SIZES)
    n = at_least_one("the number of demonstrations", n)
    options = SceneOptions(task=task, **scenes)
    parts: list[Tensor] = []
    lengths, instructions, actions = [], [], []
    bar = progress_bar(total=n, desc="record", shown=progress)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # for steps this small, threads wait more than they work
    try:
        for first in range(0, n, BATCH):
            numbers = torch.arange(first, min(n, first + BATCH))
            batch = draw_scenes(options, derive(seed, "demonstrations"), numbers)
            ties = generator(seed, "demonstrations", options.stream, "ties", first)
            frames, taken = _demonstrate(batch, ties)
            parts.append(frames)
            actions.append(taken)
            lengths.append(batch.wanted.steps + 1)
            instructions.append(batch.instruction.to(torch.int16))
            bar.update(len(batch))
    finally:
        bar.close()
        torch.set_num_threads(threads)
    numbering = generator(seed, "demonstrations", "tile numbers")
    codec, codes = FrameCodec.from_tiles(tile_table(tile_size), parts, numbering)
    tokens = torch.cat(instructions)
    demos = Demonstrations(codec, codes, torch.cat(lengths), tokens, vocabulary=VOCABULARY)
    return (demos, Truth(torch.cat(actions))) if keep_truth else demos


def _demonstrate(scenes: Scene, ties: torch.Generator) -> tuple[Tensor, Tensor]:
    """Follow the instructions of all scenes side by side.

    Return tile numbers, int16 [F, rows, columns], and actions, uint8 [F - episodes], in a row.
    """
    steps = scenes.wanted.steps
    frame_ends, action_ends = (steps + 1).cumsum(0), steps.cumsum(0)
    # Longest first, so that running episodes are always the first rows.
    steps, order = steps.sort(descending=True, stable=True)
    first_frame = (frame_ends - 1)[order] - steps
    first_action = action_ends[order] - steps
    wanted, state = scenes.wanted[order], scenes.state[order]

    frames = torch.empty(int(frame_ends[-1]), state.size, state.size, dtype=torch.int16)
    actions = torch.empty(int(action_ends[-1]), dtype=torch.uint8)
    for time in range(int(steps[0]) + 1):
        frames[first_frame[: len(state)] + time] = tile_index(state)
        acting = int((steps > time).sum())
        wanted, state = wanted[:acting], state[:acting]
        if acting:
            action = expert.act(state, wanted, ties)
            actions[first_action[:acting] + time] = action.to(torch.uint8)
            state = step(state, action)
    return frames, actions
