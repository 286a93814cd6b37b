"""What the transforms share: reset masks, models in eval mode, what an environment shows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import Compose, EnvBase, Transform

from ifo_grounding.attributes import attribute, innermost
from ifo_grounding.errors import UserError
from ifo_grounding.keys import INSTRUCTION, PIXELS


def parts_of(transform: Transform) -> list[Transform]:
    """Return the transforms that a transform is composed of, however deep, in their order."""
    if not isinstance(transform, Compose):
        return [transform]
    return [part for each in transform for part in parts_of(each)]


class EpisodeTransform(Transform):
    """A transform that acts where episodes begin and leaves the mode of its model alone.

    ``env.eval()`` and ``env.train()`` reach every transform. A model may be in training elsewhere
    at that moment, so its mode is changed only while it scores.
    """

    def train(self, mode: bool = True) -> EpisodeTransform:
        """Set the transform's own mode; not that of the modules it holds."""
        self.training = mode
        return self

    @property
    def reset_key(self) -> NestedKey:
        """Key of the mask of rows that begin an episode."""
        names = ["_reset"] if self.parent is None else self.parent.reset_keys
        if len(names) > 1 and "_reset" not in names:
            raise UserError(
                f"{type(self).__name__} needs one done entry for the whole environment, found "
                f"{len(names)}: {names}"
            )
        return "_reset" if "_reset" in names else names[0]

    def new_rows(self, tensordict: TensorDictBase | None, rows: int) -> Tensor:
        """Numbers of the rows that begin an episode, int64 [R], of ``rows`` rows."""
        mask = None if tensordict is None else tensordict.get(self.reset_key, None)
        if mask is None:
            return torch.arange(rows)
        return mask.reshape(rows, -1).any(-1).nonzero().squeeze(-1)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)


class InstructionTransform(EpisodeTransform):
    """A transform that writes an instruction at the reset and carries it to the episode's end.

    Subclasses write ``out_keys[0]`` in ``_reset``. Its spec has as many token ids as the
    environment declares in ``vocabulary_size``, or else as the instructions need.

    Args:
        tokens: all instructions that may be written, int64 [N, L].
    """

    tokens: Tensor

    def __init__(
        self,
        tokens: Tensor,
        in_keys: Sequence[NestedKey] | None,
        out_keys: Sequence[NestedKey] | None,
    ) -> None:
        super().__init__(in_keys=in_keys or [PIXELS], out_keys=out_keys or [INSTRUCTION])
        self.register_buffer("tokens", check_pool(tokens), persistent=False)

    def check_env(self, env: EnvBase) -> None:
        """Raise :class:`UserError` where an environment does not suit."""
        if exposes_state(env):
            raise UserError(
                f"{type(self).__name__} refuses an environment that exposes its true state: a "
                "learner must not see it. Make the environment with expose_state=False"
            )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        instruction = tensordict.get(self.out_keys[0], None)
        if instruction is None:
            raise UserError(f"no {self.out_keys[0]!r} to carry: step from what reset() returned")
        return next_tensordict.set(self.out_keys[0], instruction)

    def _spec(self, like: Composite) -> Bounded:
        largest = int(self.tokens.max())
        size = attribute(self.container, "vocabulary_size", largest + 1)
        if largest >= size:
            raise UserError(
                f"there is a token id {largest}, but the environment's vocabulary has {size} ids: "
                "encode instructions with its vocabulary"
            )
        shape = (*like.shape, self.tokens.shape[1])
        return Bounded(0, size - 1, shape=shape, dtype=torch.int64, device=like.device)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declare the instruction, in an environment that suits and has none."""
        if self.container is not None:
            self.check_env(self.container)
        key = self.out_keys[0]
        if key in observation_spec.keys(True, True):
            raise UserError(
                f"the environment already writes {key!r}: make it with instructed=False, or write "
                "to another key"
            )
        observation_spec[key] = self._spec(observation_spec)
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Declare that a step reads the instruction (batched environments send it to workers)."""
        state_spec[self.out_keys[0]] = self._spec(state_spec)
        return state_spec


def exposes_state(env: EnvBase) -> bool:
    """Tell whether an environment shows its true state, or can be set to one."""
    env = innermost(env)
    return bool(attribute(env, "expose_state")) or not env.state_spec.is_empty(recurse=True)


def instructs(env: EnvBase) -> bool:
    """Tell whether an environment brings instructions: as it declares, or as its specs show."""
    env = innermost(env)
    shows = INSTRUCTION in env.observation_spec.keys(True, True)
    return bool(attribute(env, "instructed", shows))


def check_pool(pool: Tensor) -> Tensor:
    """Return ``pool`` if it is int64 [N, L] with N > 0, else raise :class:`UserError`."""
    if not isinstance(pool, Tensor) or pool.ndim != 2 or pool.is_floating_point():
        got = f"{pool.dtype} {list(pool.shape)}" if isinstance(pool, Tensor) else type(pool)
        raise UserError(f"pool must be token ids, int64 [N, L], got {got}")
    if not len(pool):
        raise UserError("pool is empty: pass at least one instruction")
    return pool.to(torch.int64)


def rows_of(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return an entry of a tensordict [*B], its batch made one dimension."""
    value = tensordict.get(key, None)
    if value is None:
        raise UserError(
            f"a transform needs the entry {key!r}: the tensordict has "
            f"{sorted(map(str, tensordict.keys(True, True)))}; collect with the transform on "
            "the environment, or name other in_keys"
        )
    batch = tensordict.batch_size
    return value.reshape(batch.numel(), *value.shape[len(batch) :])


def flat_logit(logit: Tensor, rows: int, name: NestedKey) -> Tensor:
    """Return a model's output as [rows], or raise :class:`UserError` where it is no such logit."""
    if logit.numel() != rows:
        raise UserError(f"{name!r} must have shape [{rows}, 1], got {list(logit.shape)}")
    if logit.isnan().any():
        raise UserError(f"{name!r} is not a number: its network diverged or was loaded wrong")
    return logit.reshape(rows).float()
