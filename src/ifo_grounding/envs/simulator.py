"""A batch of running episodes in plain torch, shared by the TorchRL and the Gymnasium face."""

from __future__ import annotations

import torch
from torch import Tensor

from ifo_grounding.errors import UserError
from ifo_grounding.keys import STOP
from ifo_grounding.tasks.goals import fulfilled
from ifo_grounding.tasks.scenes import Scene, SceneOptions, SceneStream
from ifo_grounding.world import Canvas, render, step


class Simulator:
    """Runs ``num_envs`` episodes of numbered scenes side by side.

    Args:
        options: which scenes.
        num_envs: episodes side by side.
        seed: seed of the stream of scenes.
        tile_size: pixels along one side of a cell.
        device: where the worlds live.
    """

    def __init__(
        self,
        options: SceneOptions,
        num_envs: int,
        seed: int,
        tile_size: int = 8,
        device: torch.device | str | None = None,
    ) -> None:
        self.options, self.num_envs, self.tile_size = options, num_envs, tile_size
        self.device = torch.device(device or "cpu")
        self.steps = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self.numbers = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self.scene: Scene | None = None
        self._canvas = Canvas(tile_size)
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Go to the first scene of the stream of this seed."""
        self.stream = SceneStream(self.options, seed, self.device)
        self.next_number = 0

    def reset(self, rows: Tensor, numbers: Tensor | None = None) -> None:
        """Begin new episodes in some rows.

        Args:
            rows: which, int64 [R].
            numbers: numbers of the scenes to begin with, int64 [R]; by default the stream's next.
        """
        if numbers is None:
            first = self.next_number
            numbers = torch.arange(first, first + len(rows), device=self.device)
            self.next_number += len(rows)
        self.place(rows, self.stream.scenes(numbers))
        self.numbers[rows] = numbers

    def place(self, rows: Tensor, scenes: Scene) -> None:
        """Begin episodes with given scenes [R] in some rows."""
        if self.scene is None:
            # Every row needs a valid scene before any of them is replaced.
            self.scene = scenes[torch.zeros(self.num_envs, dtype=torch.int64)].clone()
        self.scene[rows] = scenes
        self.steps[rows] = 0
        self.numbers[rows] = -1

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Apply one action, int64 [num_envs], to each row.

        Returns:
            Success, terminated and truncated, bool [num_envs] each. Success is judged when an
            episode ends, and always false where there are no instructions.

        Raises:
            UserError: where actions have another shape, such as one-hot actions.
        """
        assert self.scene is not None, "reset before stepping"
        if action.shape != self.steps.shape:
            raise UserError(
                f"actions must be one integer for each of {self.num_envs} worlds, "
                f"got shape {list(action.shape)}"
            )
        self.scene.state = step(self.scene.state, action)
        self.steps = self.steps + 1
        terminated = action == STOP
        truncated = (self.steps >= self.options.max_steps) & ~terminated
        ended = terminated | truncated
        if not self.options.instructed:
            return torch.zeros_like(ended), terminated, truncated
        return ended & fulfilled(self.scene.state, self.scene.wanted), terminated, truncated

    @property
    def instruction(self) -> Tensor:
        """Tokens of each row's instruction, int64 [num_envs, 16]."""
        assert self.scene is not None, "reset before reading the instruction"
        return self.scene.instruction

    def pixels(self, rows: Tensor | None = None, tile_size: int | None = None) -> Tensor:
        """Draw some rows or all of them, uint8 [R, 3, H, W]."""
        assert self.scene is not None, "reset before drawing"
        if rows is None and tile_size is None:
            return self._canvas.draw(self.scene.state)
        state = self.scene.state if rows is None else self.scene.state[rows]
        return render(state, tile_size or self.tile_size)
