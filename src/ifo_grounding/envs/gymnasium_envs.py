"""The pick-and-place world as environments of Gymnasium: one world, or many side by side.

``import ifo_grounding`` registers both for each task: ``gymnasium.make("ifo_grounding/Pick-v0")``
and ``gymnasium.make_vec("ifo_grounding/Pick-v0", num_envs=256)``.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ifo_grounding.envs.gymnasium_shared import (
    Observation,
    act,
    check_options,
    draw_frames,
    make_simulator,
    make_spaces,
    observe,
    scene_numbers,
    seed_stream,
    sentences,
)
from ifo_grounding.envs.window import Window
from ifo_grounding.errors import UserError, check_choice

RENDER_FPS = 8
TEXT = "instruction_text"
SUCCESS = "is_success"


class PickAndPlaceGymEnv(gymnasium.Env[Observation, int]):
    """One pick-and-place world with an instruction.

    Observations hold ``pixels``, uint8 [3, H, W], and ``instruction``, int64 [16]; the sentence is
    in ``info["instruction_text"]``, and ``info["is_success"]`` is there when an episode ends. The
    reward is 1 for an episode that ends with its instruction fulfilled, else 0. A seeded reset goes
    to the first scene of the seed's stream and further resets follow the stream;
    ``reset(options={"scene": 7})`` begins with that scene of it.

    Args:
        task: ``move``, ``move-udlr``, ``pick``, ``pick-out`` or ``pick-udlr``.
        tile_size: pixels along one side of a cell in ``pixels``: 8, 16 or 32.
        render_mode: None, ``rgb_array`` or ``human`` (a window; needs pygame, not a screen).
        device: where the world lives.
        scene_options: fields of :class:`~ifo_grounding.tasks.SceneOptions`: ``split``,
            ``holdout``, ``holdout_visible``, ``stream``, ``layout``, ``max_steps``.

    Raises:
        UserError: on an unknown name or an impossible size.
        TypeError: on an unknown scene option.

    >>> env = PickAndPlaceGymEnv("move")
    >>> observation, info = env.reset(seed=0)
    >>> observation["pixels"].shape, info["instruction_text"][:12]
    ((3, 48, 48), 'move to the ')
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": RENDER_FPS}  # noqa: RUF012

    def __init__(
        self,
        task: str = "move",
        *,
        tile_size: int = 8,
        render_mode: str | None = None,
        device: torch.device | str | None = None,
        **scene_options: Any,
    ) -> None:
        check_choice("render mode", render_mode, (None, *self.metadata["render_modes"]))
        self.render_mode = render_mode
        self._simulator = make_simulator(task, 1, tile_size, device, scene_options)
        self.observation_space, self.action_space = make_spaces(self._simulator)
        self._text = ""
        self._row = torch.zeros(1, dtype=torch.int64, device=self._simulator.device)
        self._window = Window(RENDER_FPS) if render_mode == "human" else None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin the next episode of the stream, or the first one of ``seed``."""
        super().reset(seed=seed)
        scene = check_options(options, ("scene",)).get("scene")
        seed_stream(self._simulator, seed, self.np_random)
        number = None if scene is None else scene_numbers(scene, 1, self._simulator.device)
        self._simulator.reset(self._row, number)
        self._text = sentences(self._simulator.instruction)[0]
        self._show()
        return self._observe(), {TEXT: self._text}

    def step(self, action: int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one action, 0..5."""
        success, terminated, truncated = (
            bool(flag[0]) for flag in act(self._simulator, np.reshape(action, (-1,)))
        )
        info: dict[str, Any] = {TEXT: self._text}
        if terminated or truncated:
            info[SUCCESS] = success
        self._show()
        return self._observe(), float(success), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Draw the world, uint8 [H, W, 3]; in mode ``human`` show it in the window instead."""
        if self.render_mode == "rgb_array":
            return draw_frames(self._simulator)[0]
        self._show()
        return None

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()

    def _observe(self) -> Observation:
        return {name: value[0] for name, value in observe(self._simulator).items()}

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(draw_frames(self._simulator)[0], self._text)


class PickAndPlaceVectorEnv(gymnasium.vector.VectorEnv[Observation, np.ndarray, np.ndarray]):
    """Pick-and-place worlds side by side, all moved by one batched simulator.

    Spaces and entries are those of :class:`PickAndPlaceGymEnv`, batched; infos have Gymnasium's
    vector format. A seeded reset begins with the first ``num_envs`` scenes of the seed's stream,
    and every world that ends goes on with the stream's next scene.

    Args:
        task: ``move``, ``move-udlr``, ``pick``, ``pick-out`` or ``pick-udlr``.
        num_envs: worlds side by side.
        tile_size: pixels along one side of a cell in ``pixels``: 8, 16 or 32.
        render_mode: None or ``rgb_array``.
        autoreset_mode: when a world that ended begins anew: at the next step (Gymnasium's
            default), at the same step (the last observation is then in ``infos["final_obs"]`` and
            its infos in ``infos["final_info"]``), or only by ``reset(options={"reset_mask": ...})``
            with a bool [num_envs] (``AutoresetMode.DISABLED``).
        device: where the worlds live; observations are NumPy arrays in any case.
        scene_options: as for :class:`PickAndPlaceGymEnv`.

    Raises:
        UserError: on an unknown name or an impossible size.
        TypeError: on an unknown scene option.

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
        self.render_mode, self.num_envs = render_mode, num_envs
        self._simulator = make_simulator(task, num_envs, tile_size, device, scene_options)
        self.single_observation_space, self.single_action_space = make_spaces(self._simulator)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._texts = np.full(num_envs, "", dtype=object)
        self._ended = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin new episodes in all worlds, or in those of ``options["reset_mask"]``."""
        super().reset(seed=seed)
        known = check_options(options, ("scene", "reset_mask"))
        mask = np.asarray(known.get("reset_mask", np.ones(self.num_envs, dtype=np.bool_)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise UserError(
                f"options['reset_mask'] must be bool [{self.num_envs}], "
                f"got {mask.dtype} {list(mask.shape)}"
            )
        seed_stream(self._simulator, seed, self.np_random)
        self._begin(mask, known.get("scene"))
        return observe(self._simulator), {TEXT: self._texts.copy(), f"_{TEXT}": mask.copy()}

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one action in each world, int [num_envs].

        Raises:
            UserError: on bad actions, and on worlds that ended and were not reset
                (``AutoresetMode.DISABLED``).
        """
        stale = self._ended
        if stale.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise UserError(
                f"{stale.sum()} worlds have ended: reset them by options['reset_mask'] first"
            )
        success, terminated, truncated = act(self._simulator, np.asarray(actions))
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            success, terminated, truncated = (
                flag & ~stale for flag in (success, terminated, truncated)
            )
            self._begin(stale)
        ended = terminated | truncated
        self._ended = ended
        observations = observe(self._simulator)
        outcome = {SUCCESS: success.copy(), f"_{SUCCESS}": ended.copy()} if ended.any() else {}
        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and outcome:
            infos = self._final(observations, ended, outcome)
            self._begin(ended)
            for name, fresh in observe(self._simulator, np.flatnonzero(ended)).items():
                observations[name][ended] = fresh
        else:
            infos = outcome
        infos[TEXT] = self._texts.copy()
        infos[f"_{TEXT}"] = np.ones(self.num_envs, dtype=np.bool_)
        return observations, success.astype(np.float64), terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw each world, uint8 [H, W, 3], in mode ``rgb_array``."""
        return tuple(draw_frames(self._simulator)) if self.render_mode == "rgb_array" else None

    def _begin(self, mask: np.ndarray, scenes: Any = None) -> None:
        """Begin new episodes where ``mask``, with the given scenes [num_envs] or the next ones."""
        if not mask.any():
            return
        rows = torch.from_numpy(np.flatnonzero(mask)).to(self._simulator.device)
        numbers = None
        if scenes is not None:
            numbers = scene_numbers(scenes, self.num_envs, self._simulator.device)[rows]
        self._simulator.reset(rows, numbers)
        self._texts[mask] = sentences(self._simulator.instruction[rows])
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
        final_info = {**outcome, TEXT: texts, f"_{TEXT}": ended.copy()}
        return {
            "final_obs": last,
            "_final_obs": ended.copy(),
            "final_info": final_info,
            "_final_info": ended.copy(),
        }
