"""A batch of running episodes in plain torch, shared by the TorchRL and the Gymnasium face."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from torch import Tensor

from ifo_grounding import keys
from ifo_grounding.errors import UserError, at_least_one, check_below, check_choice
from ifo_grounding.tasks.goals import fulfilled, plan
from ifo_grounding.tasks.grammar import grammar
from ifo_grounding.tasks.scenes import FEWEST, Scene, SceneOptions, draw_scenes, leaves
from ifo_grounding.world import N_BOXES, N_KINDS, Canvas, render, step
from ifo_grounding.world.tiles import TILE_SIZES

RENDER_TILE_SIZE = 32
"""Pixels along one side of a cell in pictures for people."""
AHEAD = 16
"""Resets of all rows for which scenes are drawn ahead; then a GPU is asked how many have begun."""
CHUNK = 1 << 18
"""Most scenes that are drawn at once, for memory's sake."""


class NotBegunError(UserError, ResetNeeded):
    """A step, or a picture, before the first reset."""


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
        check_below("actions of this world hold", action, count)


class Simulator:
    """Runs ``num_envs`` episodes of numbered scenes side by side.

    What it keeps is written in place, so that a step with its reset can be one CUDA graph, and is
    no inference tensor: episodes go on outside ``torch.inference_mode`` that began inside.
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
        at_least_one("num_envs", num_envs)
        self.options, self.num_envs, self.tile_size = options, num_envs, tile_size
        self.device = torch.device(device or "cpu")
        self.steps = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self.numbers = torch.zeros(num_envs, dtype=torch.int64, device=self.device)
        self._leaves: list[Tensor] = []
        self._canvas = Canvas(tile_size)
        self.seed(seed)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy is made of: its scene consists of its own leaves."""
        return {name: value for name, value in vars(self).items() if name != "scene"}

    @torch.inference_mode(False)
    def seed(self, seed: int) -> None:
        """Go to the first scene of the stream of this seed."""
        self.seeded = self.options, seed
        self._next = torch.zeros((), dtype=torch.int64, device=self.device)
        self._ahead: list[Tensor] = []
        self._drawn = self._most = 0

    @torch.inference_mode(False)
    def to(self, device: torch.device | str) -> Simulator:
        """Move the running episodes and all that follow to a device."""
        self.device = torch.device(device)
        for name in ("steps", "numbers", "_next"):
            setattr(self, name, getattr(self, name).to(device))
        self._leaves = [leaf.to(device) for leaf in self._leaves]
        self._ahead = [leaf.to(device) for leaf in self._ahead]
        vars(self).pop("scene", None)
        self._canvas = Canvas(self.tile_size)
        return self

    @property
    def started(self) -> bool:
        """Whether there has been a reset."""
        return bool(self._leaves)

    @functools.cached_property
    def scene(self) -> Scene:
        """The worlds as they are, with what they are asked, [num_envs]."""
        if not self.started:
            raise NotBegunError("there is no episode yet: reset the environment first")
        return Scene.of(self._leaves)

    @torch.inference_mode(False)
    def reset(self, mask: Tensor | None = None, numbers: Tensor | None = None) -> None:
        """Begin new episodes, without asking a GPU where.

        Args:
            mask: in which rows, bool [num_envs]; in all by default, and at the first time.
            numbers: scenes to begin with, int64 [num_envs]; the stream's next ones by default.
        """
        if mask is None or not self.started:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        if numbers is None:
            self.draw_ahead()
            order = mask.cumsum(0)
            numbers, drawn = self._next + order - 1, self._ahead
            self._next += order[-1]
            places = numbers % len(drawn[0])
        else:
            drawn = leaves(draw_scenes(*self.seeded, numbers.where(mask, 0)))
            places = torch.arange(self.num_envs, device=self.device)
        self.steps.masked_fill_(mask, 0)
        torch.where(mask, numbers, self.numbers, out=self.numbers)
        if not self.started:
            self._leaves = [source.index_select(0, places) for source in drawn]
            return
        if self.device.type == "cpu":  # which may be asked for the rows, and copies no others
            rows = mask.nonzero().squeeze(-1)
            places = places[rows]
            for leaf, source in zip(self._leaves, drawn, strict=True):
                leaf.index_copy_(0, rows, source.index_select(0, places))
            return
        for leaf, source in zip(self._leaves, drawn, strict=True):
            new = source.index_select(0, places)
            torch.where(mask.view(-1, *[1] * (leaf.ndim - 1)), new, leaf, out=leaf)

    @torch.inference_mode(False)
    def draw_ahead(self) -> None:
        """Make sure that scenes are drawn for one more reset of all rows.

        Each reset does so; call it before each replay of a CUDA graph that resets. A scene drawn
        ahead lies at its number modulo their count.
        """
        on_cpu = self.device.type == "cpu"
        count = max(16 * FEWEST, self.num_envs * (2 if on_cpu else AHEAD))
        if on_cpu or self._most + self.num_envs > self._drawn:
            self._most = int(self._next)
        if self._most + self.num_envs > self._drawn:
            end = self._most + (count if self._ahead else max(FEWEST, self.num_envs))
            for part in torch.arange(self._drawn, end, device=self.device).split(CHUNK):
                drawn = leaves(draw_scenes(*self.seeded, part))
                if not self._ahead:
                    self._ahead = [leaf.new_empty(count, *leaf.shape[1:]) for leaf in drawn]
                for leaf, rows in zip(self._ahead, drawn, strict=True):
                    leaf.index_copy_(0, part % count, rows)
            self._drawn = end
        self._most += self.num_envs

    @torch.inference_mode(False)
    def arrange(self, rows: Tensor, worlds: Any) -> None:
        """Put worlds [R] with the entries of a :class:`WorldState` into rows that have just begun.

        Raises:
            UserError: where a world has another size, or things that there are not.
        """
        bounds = {"arm": self.scene.state.objects.shape[-1] - 1, "held": N_KINDS}
        for name, most in {**bounds, "objects": N_KINDS, "boxes": N_BOXES}.items():
            leaf, new = getattr(self.scene.state, name), worlds.get(name)
            if new.shape != leaf[rows].shape:
                raise UserError(
                    f"{name} of these worlds is {list(leaf[rows].shape)}, not {list(new.shape)}"
                )
            check_below(f"{name} of a world holds", new, most + 1)
            leaf.index_copy_(0, rows, new.to(leaf))

    @torch.inference_mode(False)
    def ask(self, rows: Tensor, tokens: Tensor) -> None:
        """Ask some rows, int64 [R], which have just begun, for sentences of the task [R, 16].

        Raises:
            UserError: where a sentence is none of the task's.
        """
        goal = grammar(self.options.task).parse_tokens(tokens)
        wanted = plan(self.scene.state[rows], goal, self.options.max_steps)
        asked = [*leaves(self.scene.wanted), self.scene.instruction]
        for leaf, new in zip(asked, [*leaves(wanted), tokens], strict=True):
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
        state = step(self.scene.state, action)
        for leaf, new in zip(leaves(self.scene.state), leaves(state), strict=True):
            leaf.copy_(new)
        self.steps += 1
        terminated = action == keys.STOP
        truncated = (self.steps >= self.options.max_steps) & ~terminated
        ended = terminated | truncated
        if not self.options.instructed:
            return torch.zeros_like(ended), terminated, truncated
        return ended & fulfilled(state, self.scene.wanted), terminated, truncated

    @torch.inference_mode(False)
    def pixels(self, rows: Tensor | None = None) -> Tensor:
        """Draw some rows or all of them, uint8 [R, 3, H, W]."""
        if rows is None:
            return self._canvas.draw(self.scene.state)
        return render(self.scene.state[rows], self.tile_size)

    def frames(self, tile_size: int = RENDER_TILE_SIZE) -> np.ndarray:
        """Draw all worlds for people, uint8 [num_envs, H, W, 3]."""
        return render(self.scene.state, tile_size).permute(0, 2, 3, 1).cpu().numpy()
