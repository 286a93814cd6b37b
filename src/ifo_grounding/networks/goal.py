"""Whether an instruction is fulfilled: an extension, learned from demonstrations' last frames."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from ifo_grounding import keys
from ifo_grounding.networks.building import build
from ifo_grounding.networks.instruction import pair_scorer
from ifo_grounding.networks.warm_start import start_scorer


def make_goal_classifier(
    spec_source: Any,
    preset: str = "strong",
    *,
    in_keys: Sequence[NestedKey] = (keys.INITIAL_PIXELS, keys.PIXELS, keys.INSTRUCTION),
    out_key: NestedKey = keys.GOAL_SCORE,
    init_from: nn.Module | None = None,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> TensorDictModule:
    """Build the goal classifier: first image, image and instruction to a logit of success [*B, 1].

    An extension of the paper, which assumes that demonstrations end in success. ``encode_scenes``
    (of both images), ``encode_instruction`` and ``score_candidates`` work as those of the
    instruction classifier.

    Args:
        spec_source: an env, a dataset or a :class:`~ifo_grounding.networks.Shapes`.
        preset: ``"strong"`` or ``"paper"``.
        in_keys: the episode's first image and the present one, uint8 [*B, C, H, W], and the
            instruction, int64 [*B, L].
        out_key: where the logit goes.
        init_from: a policy of the same preset and sizes whose weights are copied (a warm start): it
            then sees nothing of the first image, until it learns to.
        device: where to build it.
        seed: makes the initial weights a function of the seed alone.
        overrides: values of :class:`~ifo_grounding.networks.NetworkConfig` to replace.

    Raises:
        UserError: for an unknown preset or option, sizes that cannot be read, or a policy that
            does not fit.

    >>> from ifo_grounding.networks import Shapes
    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> classifier = make_goal_classifier(shapes, seed=0)
    >>> frame = torch.zeros(2, 3, 48, 48, dtype=torch.uint8)
    >>> classifier(initial_pixels=frame, pixels=frame, instruction=torch.ones(2, 16)).shape
    torch.Size([2, 1])
    """
    options = {"in_keys": in_keys, "out_key": out_key}
    scorer = partial(pair_scorer, images=2)
    classifier = build("goal", scorer, spec_source, preset, options, device, seed, overrides)
    if init_from is not None:
        start_scorer(classifier.module, init_from)
    return classifier
