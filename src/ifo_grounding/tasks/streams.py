"""Numbered scenes: every number is one fixed initial state, with a suitable goal where asked for.

A stream is a function of its seed and name: a scene can be drawn again by its number.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ifo_grounding.tasks.scenes import FEWEST, Scene, SceneOptions, draw_scenes

BLOCKS_KEPT = 16
"""Blocks that a stream remembers."""


class SceneStream:
    """The scenes of one seed, by number.

    Args:
        options: which scenes.
        seed: of what is drawn.
        device: where scenes are drawn.

    >>> stream = SceneStream(SceneOptions("pick"), seed=0)
    >>> scenes = stream.scenes(torch.tensor([5, 2000]))
    >>> scenes.instruction.shape, scenes.wanted.verdict.tolist()
    (torch.Size([2, 16]), [0, 0])
    """

    def __init__(
        self, options: SceneOptions, seed: int, device: torch.device | str | None = None
    ) -> None:
        self.options, self.seed, self.device = options, seed, torch.device(device or "cpu")
        self._blocks: dict[int, Scene] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_blocks": {}}  # a copy draws its scenes again

    def scenes(self, numbers: Tensor) -> Scene:
        """Return the scenes with the given numbers, int64 [N] from 0 on."""
        blocks, which = (numbers // FEWEST).unique(return_inverse=True)
        parts: list[Any] = [self._block(block) for block in blocks.tolist() or [0]]
        every: Any = parts[0] if len(parts) == 1 else torch.cat(parts)
        return every[which * FEWEST + numbers % FEWEST]

    def _block(self, block: int) -> Scene:
        if block not in self._blocks:
            if len(self._blocks) == BLOCKS_KEPT:
                del self._blocks[next(iter(self._blocks))]
            numbers = torch.arange(block * FEWEST, (block + 1) * FEWEST, device=self.device)
            self._blocks[block] = draw_scenes(self.options, self.seed, numbers)
        return self._blocks[block]
