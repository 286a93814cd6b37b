"""BCO(alpha): the inverse model goes on with steps of the policy (Torabi et al. 2018)."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase, TransformedEnv

from ifo_grounding import keys
from ifo_grounding.data import Collected, collect_transitions
from ifo_grounding.transforms import InstructionSampler


class HalfOfEach:
    """Two replay buffers, from each of which comes half of what is sampled.

    >>> class Ones:
    ...     def __len__(self): return 3
    ...     def sample(self, batch_size): return torch.ones(batch_size)
    >>> both = HalfOfEach(Ones(), Ones())
    >>> len(both), both.sample(5).shape
    (6, torch.Size([5]))
    """

    def __init__(self, first: ReplayBuffer, second: ReplayBuffer) -> None:
        self.first, self.second = first, second

    def __len__(self) -> int:
        return len(self.first) + len(self.second)

    def sample(self, batch_size: int) -> TensorDictBase:
        """Draw from both, [batch_size]."""
        parts = self.first.sample(batch_size - batch_size // 2), self.second.sample(batch_size // 2)
        both: TensorDictBase = torch.cat(parts)
        return both


def steps_of_policy(env: EnvBase, policy: Any, pool: Tensor, n: int, **options: Any) -> Collected:
    """Collect ``n`` steps of a policy that is told any instruction of the pool, as BCO knows none.

    Args:
        env: without instructions.
        options: for :func:`ifo_grounding.data.collect_transitions`.
    """

    def all_alike(pixels: Tensor, instruction: Tensor) -> Tensor:
        return torch.zeros(len(pixels), 1, device=pixels.device)

    read = [keys.PIXELS, keys.INSTRUCTION]
    any_suits = TensorDictModule(all_alike, read, [keys.SUITABILITY])
    told = InstructionSampler(any_suits, pool, threshold=0.0, seed=options.get("seed", 0))
    return collect_transitions(TransformedEnv(env, told), n, policy=policy, **options)
