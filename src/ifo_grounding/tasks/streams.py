"""Numbered scenes: every number is one fixed initial state, with a suitable goal where asked for.

A stream of scenes is a function of its seed and name, so that a scene can be drawn again by its
number, training and evaluation never meet, and results can name the scenes that they are about.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ifo_grounding.errors import UserError
from ifo_grounding.tasks.scenes import AHEAD, CHUNK, Scene, SceneOptions, draw_block, scene_leaves

BLOCK = AHEAD * CHUNK
"""Scenes that are drawn at once."""
BLOCKS_KEPT = 64


class SceneStream:
    """The scenes of one seed, by number.

    Args:
        options: which scenes.
        seed: of what is drawn.
        device: where scenes go; they are drawn on the CPU.
        kept: how many blocks of scenes are remembered, the last that were asked for.

    >>> stream = SceneStream(SceneOptions("pick"), seed=0)
    >>> scenes = stream.scenes(torch.tensor([5, 2000]))
    >>> scenes.instruction.shape, scenes.wanted.verdict.tolist()
    (torch.Size([2, 16]), [0, 0])
    """

    def __init__(
        self,
        options: SceneOptions,
        seed: int,
        device: torch.device | str | None = None,
        *,
        kept: int = BLOCKS_KEPT,
    ) -> None:
        self.options, self.seed = options, seed
        self.device, self.kept = torch.device(device or "cpu"), kept
        self._remember()

    def _remember(self) -> None:
        self._block = functools.lru_cache(maxsize=self.kept)(self._draw)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: scenes are drawn again."""
        return {name: value for name, value in vars(self).items() if name != "_block"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become what was copied."""
        vars(self).update(state)
        self._remember()

    def scenes(self, numbers: Tensor) -> Scene:
        """Return the scenes with the given numbers, int64 [N]."""
        blocks, rows = self._find(numbers)
        drawn = [self._block(block)[0] for block in blocks]
        return (drawn[0] if len(drawn) == 1 else _cat(drawn))[rows]

    def write(self, numbers: Tensor, leaves: list[Tensor], rows: Tensor) -> None:
        """Write the scenes with the given numbers, int64 [N], to rows of others, int64 [N].

        That is ``others[rows] = self.scenes(numbers)``, in a third of the time.

        Args:
            numbers: which scenes.
            leaves: what the others are made of, in the order of :func:`scene_leaves`.
            rows: where, each once.
        """
        blocks, found = self._find(numbers)
        drawn = [self._block(block)[1] for block in blocks]
        for leaf, *parts in zip(leaves, *drawn, strict=True):
            source = parts[0] if len(parts) == 1 else torch.cat(parts)
            leaf.index_copy_(0, rows, source.index_select(0, found))

    def _find(self, numbers: Tensor) -> tuple[list[int], Tensor]:
        """Return the blocks that hold given scenes, and the scenes' rows in all of these."""
        if not numbers.numel():
            return [0], numbers
        low, high = (int(end) for end in numbers.aminmax())
        if low < 0:
            raise UserError("scene numbers start at 0")
        if (first := low // BLOCK) == high // BLOCK:
            return [first], numbers - first * BLOCK
        blocks, place = (numbers // BLOCK).unique(return_inverse=True)
        return blocks.tolist(), place * BLOCK + numbers % BLOCK

    def _draw(self, block: int) -> tuple[Scene, list[Tensor]]:
        """Return the scenes of a block, and what they are made of."""
        scenes = draw_block(self.options, self.seed, block).to(self.device)
        return scenes, scene_leaves(scenes)


def _cat(scenes: list[Scene]) -> Scene:
    return torch.cat(scenes)  # type: ignore[arg-type, return-value]
