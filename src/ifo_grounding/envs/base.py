"""What environments of worlds with numbered scenes have in common."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from ifo_grounding import keys
from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.tasks.vocabulary import Vocabulary

DONE = ("done", "terminated", "truncated")


def begin(env: EnvBase, scenes: Tensor) -> TensorDictBase:
    """Reset every row to a scene by its number, int64 [R]; rows beyond R repeat the first one."""
    rows = env.batch_size.numel()
    numbers = torch.cat([scenes, scenes[:1].expand(rows - len(scenes))]).to(env.device or "cpu")
    return env.reset(TensorDict({keys.SCENE: numbers.view(*env.batch_size, 1)}, env.batch_size))


class NumberedEnv(EnvBase):
    """Worlds side by side whose scenes have numbers, with an image and an instruction."""

    steps_on = True
    """A row may be stepped after its end: it goes on, or stays as it is."""
    own_sentence: str
    """What to do with a sentence of one's own."""

    def __init__(
        self,
        num_envs: int,
        vocabulary: Vocabulary,
        instructed: bool,
        device: torch.device | str | None,
    ) -> None:
        num_envs = at_least_one("num_envs", num_envs)
        super().__init__(device=device or "cpu", batch_size=[num_envs])
        self.num_envs = num_envs
        self.vocabulary, self.instructed = vocabulary, instructed
        self.vocabulary_size, self.instruction_length = len(vocabulary), vocabulary.length

    def _bounded(self, high: int, *shape: int, dtype: torch.dtype = torch.int64) -> Bounded:
        shape = (*self.batch_size, *shape)
        return Bounded(0, high, shape=shape, dtype=dtype, device=self.device)

    def _declare(self, pixels: Bounded, n_actions: int, **more: Composite) -> None:
        on: Any = {"shape": self.batch_size, "device": self.device}
        observation = Composite(more, **on)
        observation[keys.PIXELS] = pixels
        if self.instructed:
            words = self._bounded(self.vocabulary_size - 1, self.instruction_length)
            observation[keys.INSTRUCTION] = words
        self.observation_spec = observation
        self.action_spec = Categorical(n_actions, **on)
        flag: Any = {"shape": (*self.batch_size, 1), "device": self.device}
        self.reward_spec = Unbounded(dtype=torch.float32, **flag)
        flags = {name: Binary(1, dtype=torch.bool, **flag) for name in DONE}
        self.done_spec = Composite(flags, **on)

    def _asked(self, tensordict: TensorDictBase | None) -> tuple[Tensor, Tensor | None]:
        """Return where episodes begin, bool [num_envs], and the scenes asked for there."""
        given: Any = {} if tensordict is None else tensordict
        everywhere = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        mask = given.get("_reset", everywhere).reshape(self.num_envs)
        numbers = given.get(keys.SCENE, None)
        if numbers is None:
            return mask, None
        if numbers.is_floating_point() or numbers.dtype == torch.bool:
            raise UserError(f"scenes are asked for by integers, got {numbers.dtype}")
        numbers = numbers.reshape(self.num_envs).to(mask.device).long()
        if bool(((numbers < 0) & mask).any()):
            raise UserError("scene numbers start at 0")
        return mask, numbers

    def _wish(self, tensordict: TensorDictBase | None, key: str = keys.INSTRUCTION) -> Any:
        """Return the instructions that a reset asks for; those of an observation are over."""
        given: Any = {} if tensordict is None else tensordict
        if not self.instructed or keys.PIXELS in given or "done" in given:
            return None
        return given.get(key, None)

    def _check_instruction(self, given: Tensor | None, asked: Tensor) -> None:
        """Refuse another instruction than the episode's; on a GPU that would wait for it."""
        if given is None or asked.device.type != "cpu":
            return
        if given.shape != asked.shape or bool((given.cpu() != asked).any()):
            raise UserError(
                f"the instruction is another than the episode began with: {self.own_sentence}"
            )
