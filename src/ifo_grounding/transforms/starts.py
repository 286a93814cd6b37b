"""Episodes that begin with stored pairs of a scene and an instruction."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase

from ifo_grounding.attributes import untransformed
from ifo_grounding.distinct import hash_rows, words_of
from ifo_grounding.errors import UserError
from ifo_grounding.keys import INSTRUCTION, SCENE
from ifo_grounding.seeding import generator
from ifo_grounding.transforms.base import InstructionTransform, rows_of

FRAME_HASH = "frame_hash"
"""Key of :func:`frame_hash` in stored pairs, int64 [N, 1]."""


class StartingPairs(InstructionTransform):
    """Begins every episode with one of a fixed list of scenes and its instruction.

    The paper's second phase explores from 5K or 10K chosen pairs (paper, "Experimental Settings");
    :func:`ifo_grounding.training.select_pairs` stores them. Each pair is used once, in random
    order, before any is used again. Every step carries the instruction along.

    Args:
        pairs: TensorDict [N] with ``scene`` int64 [N, 1] and ``instruction`` int64 [N, L]. With
            ``frame_hash`` int64 [N, 1], every scene is checked to be the one that was stored.

    Raises:
        UserError: on pairs of another form; on an environment that exposes its true state, has an
            instruction already, or draws other scenes than the stored ones; outside of a
            ``SerialEnv`` or ``ParallelEnv`` (put it inside, with a part of the pairs each).

    >>> from torchrl.envs import TransformedEnv
    >>> from ifo_grounding.envs import PickAndPlaceEnv
    >>> pairs = TensorDict(
    ...     {"scene": torch.tensor([[7], [3], [5]]), "instruction": torch.ones(3, 16).long()}, [3]
    ... )
    >>> base = PickAndPlaceEnv("move", num_envs=3, seed=0, instructed=False)
    >>> env = TransformedEnv(base, StartingPairs(pairs))
    >>> _ = env.reset()
    >>> sorted(base.scene_numbers.tolist())
    [3, 5, 7]
    """

    def __init__(
        self,
        pairs: TensorDictBase,
        seed: int = 0,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        missing = [key for key in (SCENE, INSTRUCTION) if pairs.get(key, None) is None]
        if missing:
            raise UserError(f"pairs lack {missing}: they come from select_pairs")
        super().__init__(pairs[INSTRUCTION], in_keys, out_keys)
        scene, hashes = pairs[SCENE], pairs.get(FRAME_HASH, None)
        if scene.is_floating_point() or scene.numel() != len(self.tokens):
            raise UserError(f"scene must be int64 [N, 1], got {scene.dtype} {list(scene.shape)}")
        self.register_buffer("scenes", scene.reshape(-1), persistent=False)
        self.hashes = None if hashes is None else hashes.reshape(-1)
        self.seed, self.used = seed, 0

    fixes_scenes = True
    """The simulator's own seed decides nothing, since every scene is asked for by number."""

    scenes: Tensor

    def get_extra_state(self) -> Tensor:
        """Return the place in the order: ``state_dict`` resumes there."""
        return torch.tensor([self.seed, self.used])

    def set_extra_state(self, state: Tensor) -> None:
        """Resume at a place in the order."""
        self.seed, self.used = state.tolist()

    def _take(self, count: int) -> Tensor:
        """Take the next pairs, int64 [count]: each epoch has all of them in an order of its own."""
        pairs, first = len(self.scenes), self.used
        self.used = end = first + count
        taken = [
            _order(pairs, self.seed, epoch)[max(first - epoch * pairs, 0) : end - epoch * pairs]
            for epoch in range(first // pairs, end // pairs + 1)
        ]
        return torch.cat(taken)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        parent = self.parent
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=parent.batch_size, device=parent.device)
        rows = tensordict.batch_size.numel()
        begins = self.new_rows(tensordict, rows).cpu()
        # Rows that go on get a valid number too: a first reset replaces every row.
        current = torch.zeros(rows, dtype=torch.int64)
        current[begins] = self._take(len(begins))
        self._current = current.to(self.scenes.device)
        return tensordict.set(SCENE, self.scenes[self._current].view(*tensordict.batch_size, 1))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.hashes is not None:
            pixels = rows_of(tensordict_reset, self.in_keys[0])
            rows = self.new_rows(tensordict, len(pixels)).to(pixels.device)
            pairs = self._current.to(pixels.device)[rows]
            wrong = frame_hash(pixels[rows]) != self.hashes.to(pixels.device)[pairs]
            if wrong.any():
                raise UserError(
                    f"scene {int(self.scenes[pairs[wrong][0]])} is not the one that its pair was "
                    "stored with: make the environment with the task, seed, stream, layout, "
                    "tile size and codes that select_pairs was given"
                )
        instruction = self.tokens[self._current].reshape(*tensordict_reset.batch_size, -1)
        return tensordict_reset.set(self.out_keys[0], instruction)

    def check_env(self, env: EnvBase) -> None:
        """Raise :class:`UserError` where an environment does not suit."""
        super().check_env(env)
        env = untransformed(env)
        if isinstance(env, BatchedEnvBase):
            raise UserError(
                f"{type(self).__name__} cannot reach the simulators through a "
                f"{type(env).__name__}: put it inside, around each worker's environment, with a "
                "part of the pairs for each worker"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return stored data as it is: pairs are drawn where an environment resets."""
        return tensordict


@functools.lru_cache(maxsize=8)
def _order(pairs: int, seed: int, epoch: int) -> Tensor:
    """Return the numbers of all pairs in the order of an epoch."""
    return torch.randperm(pairs, generator=generator(seed, "starting-pairs", epoch))


def frame_hash(pixels: Tensor) -> Tensor:
    """Return a number for each image, or for the codes of one, that tells images apart, int64 [B].

    >>> frames = torch.zeros(2, 3, 8, 8, dtype=torch.uint8)
    >>> frames[1, 0, 0, 0] = 1
    >>> frame_hash(frames).unique().numel()
    2
    """
    return hash_rows(words_of(pixels.to(torch.uint8) if pixels.is_floating_point() else pixels))
