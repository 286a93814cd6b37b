"""Whether an action is right (the paper's reward module)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn

from ifo_grounding import keys
from ifo_grounding.networks.base import same_batch
from ifo_grounding.networks.building import build
from ifo_grounding.networks.trunk import InstructedNetwork
from ifo_grounding.networks.warm_start import start_trunk


class RewardNetwork(InstructedNetwork):
    """rwd(s, t, a): one logit per action, of which the action at hand is read."""

    def all_actions(self, pixels: Tensor, instruction: Tensor) -> Tensor:
        """Score every action: logits, float32 [*B, A]."""
        return super().forward(pixels, instruction)

    def forward(self, pixels: Tensor, instruction: Tensor, action: Tensor) -> Tensor:  # type: ignore[override]
        """Score the action, integer [*B], for the image and instruction: logits [*B, 1]."""
        scores = self.all_actions(pixels, instruction)
        same_batch(pixels=scores.shape[:-1], action=action.shape)
        return scores.gather(-1, action.long().unsqueeze(-1))


def make_reward_model(
    spec_source: Any,
    preset: str = "strong",
    *,
    in_keys: Sequence[NestedKey] = (keys.PIXELS, keys.INSTRUCTION, keys.ACTION),
    out_key: NestedKey = keys.ACTION_SCORE,
    init_from: nn.Module | None = None,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> TensorDictModule:
    """Build the reward module: an image, an instruction and an action to a logit [*B, 1].

    ``all_actions(pixels, instruction)`` of the result scores every action at once, [*B, A].

    Args:
        spec_source: an env, a dataset or a :class:`~ifo_grounding.networks.Shapes`.
        preset: ``"strong"`` or ``"paper"``.
        in_keys: the image, uint8 [*B, C, H, W], the instruction, int64 [*B, L], and the action,
            integer [*B].
        out_key: where the logit goes.
        init_from: a policy of the same preset and sizes whose trunk's weights are copied (a warm
            start, an extension of the paper). Self-examination leads a policy to what its reward
            model likes best, so that this has to know as much.
        device: where to build it.
        seed: makes the initial weights a function of the seed alone.
        overrides: values of :class:`~ifo_grounding.networks.NetworkConfig` to replace.

    Raises:
        UserError: for an unknown preset or option, sizes that cannot be read, or a policy that
            does not fit.

    >>> from ifo_grounding.networks import Shapes
    >>> rwd = make_reward_model(Shapes(image_shape=(3, 48, 48), vocabulary_size=40), seed=0)
    >>> image, words = torch.zeros(2, 3, 48, 48, dtype=torch.uint8), torch.ones(2, 16)
    >>> rwd(pixels=image, instruction=words, action=torch.tensor([0, 5])).shape
    torch.Size([2, 1])
    """
    options = {"in_keys": in_keys, "out_key": out_key}
    model = build("reward", RewardNetwork, spec_source, preset, options, device, seed, overrides)
    if init_from is not None:
        start_trunk(model.module, init_from)
    return model
