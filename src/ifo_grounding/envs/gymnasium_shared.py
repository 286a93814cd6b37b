"""What the single and the vector face of Gymnasium share: spaces, streams, actions, pictures."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium
import numpy as np
import torch

from ifo_grounding import keys
from ifo_grounding.envs.simulator import Simulator, check_actions
from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.tasks.scenes import SceneOptions
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.world.tiles import TILE_SIZES

RENDER_TILE_SIZE = 32
OPTIONS = sorted({f.name for f in dataclasses.fields(SceneOptions)} - {"task", "instructed"})

Observation = dict[str, np.ndarray]


def sentences(tokens: torch.Tensor) -> np.ndarray:
    """Return the sentence of each row of tokens [N, L], object [N]."""
    return np.array(VOCABULARY.decode(tokens.cpu()), dtype=object)


def make_simulator(
    task: str,
    num_envs: int,
    tile_size: int,
    device: torch.device | str | None,
    scene_options: dict[str, Any],
) -> Simulator:
    """Return a simulator that :func:`seed_stream` has still to seed.

    Raises:
        UserError: on an unknown name or an impossible size.
        TypeError: on an unknown scene option.
    """
    check_choice("tile size", tile_size, TILE_SIZES)
    num_envs = at_least_one("num_envs", num_envs)
    if unknown := sorted(set(scene_options) - set(OPTIONS)):
        # A TypeError in Python's words: clients such as GymEnv read it and try without.
        raise TypeError(
            f"__init__() got an unexpected keyword argument {unknown[0]!r}: scene options are "
            + ", ".join(OPTIONS)
        )
    given = {name: value for name, value in scene_options.items() if value is not None}
    return Simulator(SceneOptions(task, **given), num_envs, 0, tile_size, device)


def make_spaces(simulator: Simulator) -> tuple[Any, Any]:
    """Return the spaces of one world's observations and actions."""
    side = simulator.options.layout.size * simulator.tile_size
    observation = gymnasium.spaces.Dict(
        {
            keys.PIXELS: gymnasium.spaces.Box(0, 255, (3, side, side), np.uint8),
            keys.INSTRUCTION: gymnasium.spaces.Box(
                0, len(VOCABULARY) - 1, (VOCABULARY.length,), np.int64
            ),
        }
    )
    return observation, gymnasium.spaces.Discrete(keys.N_ACTIONS)


def seed_stream(simulator: Simulator, seed: int | None, draw: np.random.Generator) -> None:
    """Go to the stream of ``seed``; to a drawn one where there is neither seed nor stream yet."""
    if seed is not None:
        simulator.seed(seed)
    elif not simulator.started:
        simulator.seed(int(draw.integers(2**31)))


def check_options(options: dict[str, Any] | None, allowed: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of a reset, empty for None; an unknown one is a UserError."""
    for name in options or {}:
        check_choice("reset option", name, allowed)
    return options or {}


def scene_numbers(scenes: Any, num_envs: int, device: torch.device) -> torch.Tensor:
    """Return a reset option that names scenes as int64 [num_envs]."""
    numbers = np.atleast_1d(np.asarray(scenes))
    if numbers.shape != (num_envs,) or not np.issubdtype(numbers.dtype, np.integer):
        raise UserError(f"options['scene'] must be integers, one for each of {num_envs} worlds")
    return torch.as_tensor(numbers.astype(np.int64), device=device)


def act(simulator: Simulator, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Step all worlds; return success, terminated and truncated, bool [num_envs] each.

    Raises:
        ResetNeeded: before the first reset.
        UserError: unless actions are integers 0..5, [num_envs].
    """
    if not simulator.started:
        raise gymnasium.error.ResetNeeded("call reset() before step()")
    given = torch.from_numpy(np.ascontiguousarray(actions))
    check_actions(given, simulator.num_envs, keys.N_ACTIONS)
    success, terminated, truncated = simulator.step(given.to(simulator.device, torch.int64))
    return success.cpu().numpy(), terminated.cpu().numpy(), truncated.cpu().numpy()


def observe(simulator: Simulator, rows: np.ndarray | None = None) -> Observation:
    """Return what all worlds show, or those of ``rows``, in new arrays."""
    index = None if rows is None else torch.from_numpy(rows).to(simulator.device)
    tokens = simulator.instruction.clone() if index is None else simulator.instruction[index]
    return {
        keys.PIXELS: simulator.pixels(index).cpu().numpy(),
        keys.INSTRUCTION: tokens.cpu().numpy(),
    }


def draw_frames(simulator: Simulator) -> np.ndarray:
    """Draw all worlds for people, uint8 [num_envs, H, W, 3]."""
    if not simulator.started:
        raise gymnasium.error.ResetNeeded("call reset() before render()")
    return simulator.pixels(tile_size=RENDER_TILE_SIZE).permute(0, 2, 3, 1).cpu().numpy()
