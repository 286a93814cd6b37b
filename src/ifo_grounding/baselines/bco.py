"""BCO(alpha): the inverse model goes on with steps of the policy (Torabi et al. 2018)."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from ifo_grounding import keys
from ifo_grounding.data import Collected, collect_transitions
from ifo_grounding.transforms import InstructionSampler


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
