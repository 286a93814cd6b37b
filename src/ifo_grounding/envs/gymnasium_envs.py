"""The pick-and-place world as environments of Gymnasium: one world, or many side by side.

``import ifo_grounding`` registers both for each task: ``gymnasium.make("ifo_grounding/Pick-v0")``
and ``gymnasium.make_vec("ifo_grounding/Pick-v0", num_envs=256)``.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ifo_grounding import keys
from ifo_grounding.envs.simulator import Simulator, check_actions
from ifo_grounding.envs.window import Window
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.tasks.scenes import SceneOptions
from ifo_grounding.tasks.vocabulary import VOCABULARY

RENDER_FPS = 8
TEXT = "instruction_text"
SUCCESS = "is_success"

Observation = dict[str, np.ndarray]


class PickAndPlaceVectorEnv(gymnasium.vector.VectorEnv[Observation, np.ndarray, np.ndarray]):
    """Pick-and-place worlds side by side, all moved by one batched simulator.

    Observations hold ``pixels``, uint8 [N, 3, H, W], and ``instruction``, int64 [N, 16]; sentences
    are in ``infos["instruction_text"]``, and ``infos["is_success"]`` is there when an episode ends.
    The reward is 1 for an episode that ends with its instruction fulfilled, else 0. A seeded reset
    begins with the first scenes of the seed's stream, and every world that ends goes on with its
    next one; ``reset(options={"scene": numbers})`` begins with numbered ones, int [N].

    Args:
        task: ``move``, ``move-udlr``, ``pick``, ``pick-out`` or ``pick-udlr``.
        num_envs: worlds side by side, N.
        tile_size: pixels along one side of a cell in ``pixels``: 8, 16 or 32.
        render_mode: None or ``rgb_array``.
        autoreset_mode: when a world that ended begins anew: at the next step (Gymnasium's
            default), at the same step (the last observation is then in ``infos["final_obs"]`` and
            its infos in ``infos["final_info"]``), or only by ``reset(options={"reset_mask": ...})``
            with a bool [num_envs] (``AutoresetMode.DISABLED``).
        device: where the worlds live; observations are NumPy arrays in any case.
        scene_options: fields of :class:`~ifo_grounding.tasks.SceneOptions`: ``split``,
            ``holdout``, ``holdout_visible``, ``stream``, ``layout``, ``max_steps``.

    >>> env = PickAndPlaceVectorEnv("pick", num_envs=3)
    >>> observations, infos = env.reset(seed=0)
    >>> observations["pixels"].shape, observations["instruction"].shape
    ((3, 3, 48, 48), (3, 16))
    """

    def __init__(
        self,
        task: str = "move",
        num_envs: int = 1,
        *,
        tile_size: int = 8,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        device: torch.device | str | None = None,
        **scene_options: Any,
    ) -> None:
        check_choice("render mode", render_mode, (None, "rgb_array"))
        if not isinstance(autoreset_mode, AutoresetMode):
            check_choice("autoreset mode", autoreset_mode, [mode.value for mode in AutoresetMode])
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": RENDER_FPS,
            "autoreset_mode": self.autoreset_mode,
        }
        given = {name: value for name, value in scene_options.items() if value is not None}
        options = SceneOptions(task, instructed=True, **given)
        self._simulator = Simulator(options, num_envs, 0, tile_size, device)
        self.render_mode, self.num_envs = render_mode, num_envs
        side = self._simulator.options.layout.size * tile_size
        words = Box(0, len(VOCABULARY) - 1, (VOCABULARY.length,), np.int64)
        self.single_observation_space = Dict(
            {keys.PIXELS: Box(0, 255, (3, side, side), np.uint8), keys.INSTRUCTION: words}
        )
        self.single_action_space = Discrete(keys.N_ACTIONS)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._texts = np.full(num_envs, "", dtype=object)
        self._ended = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin new episodes in all worlds, or in those of ``options["reset_mask"]``."""
        super().reset(seed=seed)
        options = options or {}
        for name in options:
            check_choice("reset option", name, ("scene", "reset_mask"))
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, dtype=np.bool_)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise UserError(
                f"options['reset_mask'] must be bool [{self.num_envs}], "
                f"got {mask.dtype} {list(mask.shape)}"
            )
        if seed is not None:
            self._simulator.seed(seed)
        elif not self._simulator.started:
            self._simulator.seed(int(self.np_random.integers(2**31)))
        self._begin(mask, options.get("scene"))
        return self._observe(), {TEXT: self._texts.copy(), f"_{TEXT}": mask.copy()}

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one action in each world, int [num_envs].

        Raises:
            ResetNeeded: before the first reset.
            UserError: on bad actions, and on worlds that ended and were not reset
                (``AutoresetMode.DISABLED``).
        """
        stale = self._ended
        if stale.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise UserError(
                f"{stale.sum()} worlds have ended: reset them by options['reset_mask'] first"
            )
        success, terminated, truncated = self._act(actions)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            success, terminated, truncated = (
                flag & ~stale for flag in (success, terminated, truncated)
            )
            self._begin(stale)
        self._ended = ended = terminated | truncated
        observations = self._observe()
        infos: dict[str, Any] = {}
        if ended.any():
            infos = {SUCCESS: success.copy(), f"_{SUCCESS}": ended.copy()}
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                infos = self._final(observations, ended, infos)
                self._begin(ended)
                for name, fresh in self._observe(np.flatnonzero(ended)).items():
                    observations[name][ended] = fresh
        infos[TEXT] = self._texts.copy()
        infos[f"_{TEXT}"] = np.ones(self.num_envs, dtype=np.bool_)
        return observations, success.astype(np.float64), terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw each world, uint8 [H, W, 3], in mode ``rgb_array``."""
        return tuple(self._simulator.frames()) if self.render_mode == "rgb_array" else None

    def _act(self, actions: np.ndarray) -> list[np.ndarray]:
        """Step all worlds; return success, terminated and truncated, bool [N] each."""
        given = torch.from_numpy(np.ascontiguousarray(actions))
        check_actions(given, self.num_envs, keys.N_ACTIONS)
        outcome = self._simulator.step(given.to(self._simulator.device, torch.int64))
        return [flag.cpu().numpy() for flag in outcome]

    def _observe(self, rows: np.ndarray | None = None) -> Observation:
        """Return what all worlds show, or those of ``rows``, in new arrays."""
        simulator = self._simulator
        index = None if rows is None else torch.from_numpy(rows).to(simulator.device)
        asked = simulator.scene.instruction
        tokens = asked.clone() if index is None else asked[index]
        return {
            keys.PIXELS: simulator.pixels(index).cpu().numpy(),
            keys.INSTRUCTION: tokens.cpu().numpy(),
        }

    def _begin(self, mask: np.ndarray, scenes: Any = None) -> None:
        """Begin new episodes where ``mask``, with the given scenes [num_envs] or the next ones."""
        if not mask.any():
            return
        begins = torch.tensor(mask, device=self._simulator.device)
        numbers = None
        if scenes is not None:
            given = np.atleast_1d(np.asarray(scenes))
            if given.shape != (self.num_envs,) or not np.issubdtype(given.dtype, np.integer):
                raise UserError(
                    f"options['scene'] must be integers, one for each of {self.num_envs} worlds"
                )
            numbers = torch.from_numpy(given.astype(np.int64)).to(self._simulator.device)
        self._simulator.reset(begins, numbers)
        self._texts[mask] = VOCABULARY.decode(self._simulator.scene.instruction[begins].cpu())
        self._ended = self._ended & ~mask

    def _final(
        self, observations: Observation, ended: np.ndarray, outcome: dict[str, np.ndarray]
    ) -> dict[str, Any]:
        """Return what Gymnasium says of episodes that end as new ones begin."""
        last = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended):
            last[row] = {name: value[row].copy() for name, value in observations.items()}
        texts = self._texts.copy()
        texts[~ended] = None
        return {
            "final_obs": last,
            "_final_obs": ended.copy(),
            "final_info": {**outcome, TEXT: texts, f"_{TEXT}": ended.copy()},
            "_final_info": ended.copy(),
        }


class PickAndPlaceGymEnv(gymnasium.Env[Observation, int]):
    """One pick-and-place world with an instruction: a row of :class:`PickAndPlaceVectorEnv`.

    Args:
        task: ``move``, ``move-udlr``, ``pick``, ``pick-out`` or ``pick-udlr``.
        render_mode: None, ``rgb_array`` or ``human`` (a window; needs pygame, not a screen).
        options: ``tile_size``, ``device`` and scene options, as for many worlds.

    >>> env = PickAndPlaceGymEnv("move")
    >>> observation, info = env.reset(seed=0)
    >>> observation["pixels"].shape, info["instruction_text"][:12]
    ((3, 48, 48), 'move to the ')
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": RENDER_FPS}  # noqa: RUF012

    def __init__(
        self, task: str = "move", *, render_mode: str | None = None, **options: Any
    ) -> None:
        check_choice("render mode", render_mode, (None, *self.metadata["render_modes"]))
        self.render_mode = render_mode
        self._worlds = PickAndPlaceVectorEnv(task, 1, **options)
        self.observation_space = self._worlds.single_observation_space
        self.action_space = self._worlds.single_action_space
        self._window = Window(RENDER_FPS) if render_mode == "human" else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin the next episode of the stream, or the first one of ``seed``."""
        super().reset(seed=seed)
        worlds, simulator = self._worlds, self._worlds._simulator
        worlds.np_random = self.np_random
        if options or seed is not None or not simulator.started:
            worlds.reset(seed=seed, options=options)
        else:  # without masks, a sixth faster
            simulator.reset()
            worlds._texts[:] = VOCABULARY.decode(simulator.scene.instruction.cpu())
        self._show()
        observation = {name: value[0] for name, value in worlds._observe().items()}
        return observation, {TEXT: worlds._texts[0]}

    def step(self, action: int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one action, 0..5."""
        outcome = self._worlds._act(np.reshape(action, (-1,)))
        success, terminated, truncated = (bool(flag[0]) for flag in outcome)
        info: dict[str, Any] = {TEXT: self._worlds._texts[0]}
        if terminated or truncated:
            info[SUCCESS] = success
        self._show()
        observation = {name: value[0] for name, value in self._worlds._observe().items()}
        return observation, float(success), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Draw the world, uint8 [H, W, 3]; in mode ``human`` show it in the window instead."""
        if self.render_mode == "rgb_array":
            return self._worlds._simulator.frames()[0]
        self._show()
        return None

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._worlds._simulator.frames()[0], self._worlds._texts[0])
