"""A batch of running episodes in plain torch, shared by the TorchRL and the Gymnasium face."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.tasks.goals import Plan, fulfilled, plan
from ifo_grounding.tasks.grammar import grammar
from ifo_grounding.tasks.scenes import Scene, SceneOptions, leaves
from ifo_grounding.tasks.streams import SceneStream
from ifo_grounding.world import Canvas, WorldState, render, step
from ifo_grounding.world.tiles import TILE_SIZES

RENDER_TILE_SIZE = 32
"""Pixels along one side of a cell in pictures for people."""


def check_actions(action: Tensor, worlds: int, count: int) -> None:
    """Raise :class:`UserError` where actions are not one number below ``count`` for each world.

    On a GPU numbers are not looked at, for that would wait for it.
    """
    if action.shape != (worlds,) or action.is_floating_point() or action.dtype == torch.bool:
        raise UserError(
            f"actions must be one integer for each of {worlds} worlds, "
            f"got {action.dtype} of shape {list(action.shape)}"
        )
    if action.device.type == "cpu":
        low, high = (int(bound) for bound in action.aminmax())
        if low < 0 or high >= count:
            raise UserError(
                f"actions are 0..{count - 1} here, got {low}..{high}: was the policy made for "
                "another world?"
            )


class Simulator:
    """Runs ``num_envs`` episodes of numbered scenes side by side.

    What it keeps is no inference tensor, so that episodes go on outside ``torch.inference_mode``
    that began inside.

    Raises:
        UserError: on an impossible number or size.
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        options: SceneOptions,
        num_envs: int,
        seed: int,
        tile_size: int = 8,
        device: torch.device | str | None = None,
    ) -> None:
        check_choice("tile size", tile_size, TILE_SIZES)
        for name in ("instructed", "holdout_visible"):
            check_choice(name, getattr(options, name), (True, False))
        at_least_one("num_envs", num_envs)
        self.options, self.num_envs, self.tile_size = options, num_envs, tile_size
        self.device = torch.device(device or "cpu")
        self.steps = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self.numbers = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self._episodes: _Episodes | None = None
        self._canvas = Canvas(tile_size)
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Go to the first scene of the stream of this seed."""
        self.stream = SceneStream(self.options, seed, self.device)
        self.next_number = 0

    @torch.inference_mode(False)
    def to(self, device: torch.device | str) -> Simulator:
        """Move the running episodes and all that follow to a device."""
        self.device = torch.device(device)
        self.steps, self.numbers = self.steps.to(self.device), self.numbers.to(self.device)
        if self._episodes is not None:
            scene = self.scene.to(self.device)
            self._episodes = _Episodes(scene.state, scene.wanted, scene.instruction)
        self._canvas = Canvas(self.tile_size)
        self.stream = SceneStream(self.stream.options, self.stream.seed, self.device)
        return self

    @property
    def started(self) -> bool:
        """Whether there has been a reset."""
        return self._episodes is not None

    @property
    def state(self) -> WorldState:
        """The worlds as they are, [num_envs]."""
        return self._running.state

    @property
    def scene(self) -> Scene:
        """The worlds as they are, with what they are asked, [num_envs]."""
        now = self._running
        return Scene(now.state, now.wanted, now.instruction, batch_size=[self.num_envs])

    @property
    def instruction(self) -> Tensor:
        """Tokens of each row's instruction, int64 [num_envs, 16]."""
        return self._running.instruction

    @property
    def _running(self) -> _Episodes:
        if self._episodes is None:
            raise UserError("there is no episode yet: reset the environment first")
        return self._episodes

    @torch.inference_mode(False)
    def reset(self, rows: Tensor, numbers: Tensor | None = None) -> None:
        """Begin new episodes in some rows, int64 [R], by default with the stream's next scenes."""
        if numbers is None:
            first = self.next_number
            numbers = torch.arange(first, first + len(rows), device=self.device)
            self.next_number += len(rows)
        if self._episodes is None:
            # Every row needs a valid scene before any of them is replaced.
            every = self.stream.scenes(numbers[:1].expand(self.num_envs)).clone()
            self._episodes = _Episodes(every.state, every.wanted, every.instruction)
        self.stream.write(numbers, self._episodes.leaves(), rows)
        self.steps[rows] = 0
        self.numbers = self.numbers.index_copy(0, rows, numbers)  # others may hold the old ones

    @torch.inference_mode(False)
    def ask(self, rows: Tensor, tokens: Tensor) -> None:
        """Ask some rows, int64 [R], which have just begun, for sentences of the task [R, 16].

        Raises:
            UserError: where a sentence is none of the task's.
        """
        goal = grammar(self.options.task).parse_tokens(tokens)
        wanted = plan(self.state[rows], goal, self.options.max_steps)
        for leaf, new in zip(self._running.asked, [*leaves(wanted), tokens], strict=True):
            leaf.index_copy_(0, rows, new.to(leaf))

    @torch.inference_mode(False)
    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Apply one action, int64 [num_envs], to each row.

        Returns:
            Success, terminated and truncated, bool [num_envs] each. Success is told when an
            episode ends, and always false where there are no instructions.

        Raises:
            UserError: where actions have another shape, such as one-hot actions, or are others.
        """
        check_actions(action, self.num_envs, keys.N_ACTIONS)
        self._running.state = state = step(self.state, action)
        self.steps = self.steps + 1
        terminated = action == keys.STOP
        truncated = (self.steps >= self.options.max_steps) & ~terminated
        ended = terminated | truncated
        if not self.options.instructed:
            return torch.zeros_like(ended), terminated, truncated
        return ended & fulfilled(state, self._running.wanted), terminated, truncated

    @torch.inference_mode(False)
    def pixels(self, rows: Tensor | None = None) -> Tensor:
        """Draw some rows or all of them, uint8 [R, 3, H, W]."""
        if rows is None:
            return self._canvas.draw(self.state)
        return render(self.state[rows], self.tile_size)

    def frames(self, tile_size: int = RENDER_TILE_SIZE) -> np.ndarray:
        """Draw all worlds for people, uint8 [num_envs, H, W, 3]."""
        return render(self.state, tile_size).permute(0, 2, 3, 1).cpu().numpy()


class _Episodes:
    """A scene for each row, whose state goes on."""

    def __init__(self, state: WorldState, wanted: Plan, instruction: Tensor) -> None:
        self.state, self.wanted, self.instruction = state, wanted, instruction
        self.asked = [*leaves(wanted), instruction]  # written to, and never replaced

    def __getstate__(self) -> tuple[WorldState, Plan, Tensor]:
        """Return what a copy is made of. Left alone, deepcopy shares the tensors of a state."""
        return self.state.clone(), self.wanted.clone(), self.instruction.clone()

    def __setstate__(self, parts: tuple[WorldState, Plan, Tensor]) -> None:
        """Become what was copied; what is written to has to be what is read."""
        self.__init__(*parts)  # type: ignore[misc]

    def leaves(self) -> list[Tensor]:
        """Everything that episodes are made of, as of scenes."""
        return [*leaves(self.state), *self.asked]
