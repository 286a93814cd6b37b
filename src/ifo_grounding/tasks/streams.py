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
        parts = self._find(numbers)
        found = [self._block(block)[0][rows] for block, rows, _ in parts]
        if len(found) == 1:
            return found[0]
        order = torch.cat([places for _, _, places in parts])
        return _cat(found)[order.argsort()]

    def write(self, numbers: Tensor, leaves: list[Tensor], rows: Tensor) -> None:
        """Write the scenes with the given numbers, int64 [N], to rows of others, int64 [N].

        That is ``others[rows] = self.scenes(numbers)``, in a third of the time.

        Args:
            numbers: which scenes.
            leaves: what the others are made of, in the order of :func:`scene_leaves`.
            rows: where, each once.
        """
        parts = self._find(numbers)
        for block, found, places in parts:
            there = rows if len(parts) == 1 else rows[places]
            for leaf, source in zip(leaves, self._block(block)[1], strict=True):
                leaf.index_copy_(0, there, source.index_select(0, found))

    def _find(self, numbers: Tensor) -> list[tuple[int, Tensor, Tensor]]:
        """Return the blocks that hold given scenes, their rows there, and their places here."""
        if not numbers.numel():
            return [(0, numbers, numbers)]
        low, high = (int(end) for end in numbers.aminmax())
        if low < 0:
            raise UserError("scene numbers start at 0")
        everywhere = torch.arange(len(numbers), device=numbers.device)
        if (first := low // BLOCK) == high // BLOCK:
            return [(first, numbers - first * BLOCK, everywhere)]
        blocks, which = (numbers // BLOCK).unique(return_inverse=True)
        parts = []
        for each, block in enumerate(blocks.tolist()):
            places = (which == each).nonzero().squeeze(-1)
            parts.append((block, numbers[places] - block * BLOCK, places))
        return parts

    def _draw(self, block: int) -> tuple[Scene, list[Tensor]]:
        """Return the scenes of a block, and what they are made of."""
        scenes = draw_block(self.options, self.seed, block).to(self.device)
        return scenes, scene_leaves(scenes)


def _cat(scenes: list[Scene]) -> Scene:
    return torch.cat(scenes)  # type: ignore[arg-type, return-value]
