"""The pick-and-place world as a batched TorchRL environment."""

from __future__ import annotations

import dataclasses
import secrets
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from ifo_grounding import keys
from ifo_grounding.envs.base import DONE, NumberedEnv
from ifo_grounding.envs.simulator import RENDER_TILE_SIZE, Simulator
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.seeding import generator
from ifo_grounding.tasks.goals import MAX_STEPS
from ifo_grounding.tasks.scenes import Scene, SceneOptions
from ifo_grounding.tasks.vocabulary import VOCABULARY
from ifo_grounding.world import N_BOXES, N_KINDS, Layout, tile_index, tile_table

STATE = "state"


class PickAndPlaceEnv(NumberedEnv):
    """A batch of 6x6 pick-and-place worlds with instructions.

    An episode ends when the policy stops (terminated) or after ``max_steps`` actions (truncated);
    the reward is 1 if its instruction is then fulfilled, else 0 (paper, "Environment for Proposed
    Task"). A world that has ended goes on where it is not reset, and may be paid again: a transform
    that steps several times at once, such as TorchRL's ``FrameSkipTransform``, does not fit it.

    Args:
        task: ``move``, ``move-udlr``, ``pick``, ``pick-out`` or ``pick-udlr``.
        seed: seed of the stream of scenes; random by default.
        tile_size: pixels along one side of a cell: 8, 16 or 32.
        split: ``all``, ``train`` or ``zero-shot`` instructions.
        instructed: whether scenes come with a suitable instruction. Without, there is no goal, no
            instruction and no reward.
        expose_state: whether the true state is in the tensordict, for tools other than learners:
            adds ``("state", ...)`` entries.
        codes: whether ``"pixels"`` holds, instead of the image, which tile lies where, int16
            [*B, 6, 6]: arbitrary numbers of :attr:`tiles`. Networks that are built for this
            environment read them (:func:`ifo_grounding.networks.read_codes`).

    The others are fields of :class:`~ifo_grounding.tasks.SceneOptions`.

    A reset tensordict may hold ``"scene"``, int64 [*B, 1], the numbers of the scenes to begin with,
    and, where it is no observation (``"pixels"``, ``"done"``) and the worlds are instructed, an
    ``"instruction"`` of the task, int64 [*B, 16], and a ``"state"``, a
    :class:`~ifo_grounding.world.WorldState` [*B], in place of the scene's own. An instruction that
    cannot be fulfilled is never rewarded.

    >>> env = PickAndPlaceEnv("pick-out", num_envs=4, seed=0)
    >>> rollout = env.rollout(40, break_when_any_done=False)
    >>> rollout["pixels"].shape, rollout["next", "reward"].shape
    (torch.Size([4, 40, 3, 48, 48]), torch.Size([4, 40, 1]))
    """

    stop_action = keys.STOP
    """The action by which a policy ends an episode."""
    own_sentence = (
        "give it to reset(), in a TensorDict of 'scene' (env.scene_numbers for the same scenes) "
        "and 'instruction'"
    )

    def __init__(
        self,
        task: str = "move",
        num_envs: int = 1,
        device: torch.device | str | None = None,
        seed: int | None = None,
        tile_size: int = 8,
        split: str = "all",
        instructed: bool = True,
        expose_state: bool = False,
        codes: bool = False,
        *,
        holdout: str = "pairs-3",
        holdout_visible: bool = True,
        stream: str = "training",
        layout: Layout | None = None,
        max_steps: int = MAX_STEPS,
    ) -> None:
        options = SceneOptions(
            task=task,
            instructed=instructed,
            split=split,
            holdout=holdout,
            holdout_visible=holdout_visible,
            stream=stream,
            layout=layout or Layout(),
            max_steps=max_steps,
        )
        super().__init__(num_envs, VOCABULARY, instructed, device)
        check_choice("expose_state", expose_state, (True, False))
        self.tile_size, self.expose_state = tile_size, expose_state
        seed = secrets.randbits(31) if seed is None else seed
        self._simulator = Simulator(options, num_envs, seed, tile_size, self.device)
        self._shown = [keys.PIXELS, keys.INSTRUCTION] if instructed else [keys.PIXELS]
        side = options.layout.size * tile_size
        self.image_shape = (3, side, side)
        state = {STATE: self._state_spec()} if expose_state else {}
        self._number: Tensor | None = None
        pixels = self._bounded(255, *self.image_shape, dtype=torch.uint8)
        check_choice("codes", codes, (True, False))
        if codes:
            count, grid = len(tile_table(tile_size)), [options.layout.size] * 2
            number = torch.randperm(count, generator=generator(0, "codes"))
            self._number = number.to(self.device, torch.int16)
            pixels = self._bounded(count - 1, *grid, dtype=torch.int16)
        self._declare(pixels, keys.N_ACTIONS, **state)

    @property
    def options(self) -> SceneOptions:
        """Which scenes."""
        return self._simulator.options

    @property
    def task(self) -> str:
        """Name of the task."""
        return self.options.task

    @property
    def stream(self) -> str:
        """Name of the stream of scenes; another one that is set is gone to at the next seeding."""
        return self.options.stream

    @stream.setter
    def stream(self, stream: str) -> None:
        self._simulator.options = dataclasses.replace(self.options, stream=stream)

    @property
    def scene_numbers(self) -> Tensor:
        """Number of the scene that each row began with, int64 [num_envs]."""
        return self._simulator.numbers.clone()

    @property
    def tiles(self) -> Tensor | None:
        """What codes stand for, uint8 [1456, 3, T, T]; None where pixels are shown."""
        if self._number is None:
            return None
        tiles = tile_table(self.tile_size).to(self.device)
        return torch.empty_like(tiles).index_copy_(0, self._number.long(), tiles)

    @property
    def truth(self) -> Scene:
        """The worlds as they are and what they are asked, [num_envs]; clone what is to be kept.

        For evaluation only.

        Raises:
            UserError: where ``instructed=False``, as a learner's environment is.
        """
        if not self.instructed:
            raise UserError("an environment with instructed=False keeps its true state to itself")
        return self._simulator.scene

    def to(self, device: torch.device | str) -> PickAndPlaceEnv:
        """Move the worlds, with the episodes that run in them, to a device."""
        super().to(device)
        self._simulator.to(self.device)
        self._number = None if self._number is None else self._number.to(self.device)
        return self

    def _state_spec(self) -> Composite:
        cells = self.options.layout.size**2
        parts = {
            "arm": self._bounded(cells - 1),
            "held": self._bounded(N_KINDS, dtype=torch.uint8),
            "objects": self._bounded(N_KINDS, cells, dtype=torch.uint8),
            "boxes": self._bounded(N_BOXES, cells, dtype=torch.uint8),
        }
        return Composite(parts, shape=self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask, numbers = self._asked(tensordict)
        self._simulator.reset(mask, numbers)
        tokens, arranged = self._wish(tensordict), self._wish(tensordict, STATE)
        if tokens is not None or arranged is not None:
            rows = mask.nonzero().squeeze(-1)
            if arranged is not None:
                self._simulator.arrange(rows, arranged[rows])
            self._simulator.ask(
                rows, (self._simulator.scene.instruction if tokens is None else tokens)[rows]
            )
        return self._observe()

    def _reset_proc_data(
        self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        """Keep what the reset shows of all rows, new and running ones.

        EnvBase chooses between old and new pixel by pixel, which takes longer than all else in a
        step. Done flags, actions and entries of others are blank where an episode begins, as
        EnvBase leaves them.
        """
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if tensordict is None or mask is None or self.expose_state:
            return super()._reset_proc_data(tensordict, tensordict_reset)
        merged = {name: tensordict_reset[name] for name in self._shown}
        if not set(DONE) <= tensordict.keys():
            rest = tensordict.exclude(*self._shown)
            rest_reset = tensordict_reset.exclude(*self._shown)
            return super()._reset_proc_data(rest, rest_reset).update(merged)
        begins = mask.reshape(self.num_envs)

        def blank(value: Tensor) -> Tensor:
            return value.masked_fill(begins.view(-1, *[1] * (value.ndim - 1)), 0)

        return tensordict.exclude("_reset", *self._shown).apply(blank).update(merged)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.instructed:
            asked = self._simulator.scene.instruction
            self._check_instruction(tensordict.get(keys.INSTRUCTION, None), asked)
        success, terminated, truncated = self._simulator.step(tensordict.get(keys.ACTION))
        result = self._observe()
        result[keys.REWARD] = success.float().unsqueeze(-1)
        result["done"] = (terminated | truncated).unsqueeze(-1)
        result["terminated"] = terminated.unsqueeze(-1)
        result["truncated"] = truncated.unsqueeze(-1)
        return result

    def _observe(self) -> TensorDict:
        result = TensorDict({}, batch_size=self.batch_size, device=self.device)
        scene = self._simulator.scene
        if self._number is None:
            result[keys.PIXELS] = self._simulator.pixels()
        else:
            index = tile_index(scene.state)
            codes = self._number.index_select(0, index.flatten().int())
            result[keys.PIXELS] = codes.view_as(index)
        if self.instructed:
            result[keys.INSTRUCTION] = scene.instruction.clone()
        if self.expose_state:
            result[STATE] = scene.state.to_tensordict()
        return result

    def _set_seed(self, seed: int | None) -> None:
        self._simulator.seed(secrets.randbits(31) if seed is None else seed)

    def render(self, tile_size: int = RENDER_TILE_SIZE) -> np.ndarray:
        """Draw all worlds for people, uint8 [num_envs, H, W, 3]."""
        return self._simulator.frames(tile_size)
