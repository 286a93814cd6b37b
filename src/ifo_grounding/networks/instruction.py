"""Which instruction suits a scene (the paper's instruction module)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from ifo_grounding import keys
from ifo_grounding.networks.building import build
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.scoring import GatedScorer, PairScorer
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.warm_start import start_scorer
from ifo_grounding.networks.word_scoring import WordScorer


def pair_scorer(shapes: Shapes, config: NetworkConfig, images: int = 1) -> PairScorer:
    """Return the preset's network that scores ``images`` images with an instruction."""
    kind = GatedScorer if config.preset == "paper" else WordScorer
    return kind(shapes, config, images)


def make_instruction_classifier(
    spec_source: Any,
    preset: str = "strong",
    *,
    in_keys: Sequence[NestedKey] = (keys.PIXELS, keys.INSTRUCTION),
    out_key: NestedKey = keys.SUITABILITY,
    init_from: nn.Module | None = None,
    roles: bool = False,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> TensorDictModule:
    """Build the instruction module: an image and an instruction to a logit of suitability [*B, 1].

    ``encode_scenes``, ``encode_instruction`` and ``score_candidates`` of the result score many
    instructions per image cheaply.

    Args:
        spec_source: an env, a dataset or a :class:`~ifo_grounding.networks.Shapes`.
        preset: ``"strong"`` or ``"paper"``.
        in_keys: the image, uint8 [*B, C, H, W], and the instruction, int64 [*B, L].
        out_key: where the logit goes; the paper's threshold of 0.8 is on its sigmoid.
        init_from: a policy of the same preset and sizes whose weights are copied (a warm start, an
            extension of the paper). It has learned what the words look like, which first frames
            alone teach slowly.
        roles: whether to copy as well which words count for which map of that policy (``strong``).
            Most policies know; one that finds object and target by one map, one after the other,
            does not.
        device: where to build it.
        seed: makes the initial weights a function of the seed alone.
        overrides: values of :class:`~ifo_grounding.networks.NetworkConfig` to replace.

    Raises:
        UserError: for an unknown preset or option, sizes that cannot be read, or a policy that
            does not fit.

    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> classifier = make_instruction_classifier(shapes, seed=0)
    >>> scenes = classifier.encode_scenes(torch.zeros(5, 3, 48, 48, dtype=torch.uint8))
    >>> pool = classifier.encode_instruction(torch.randint(40, (7, 16)))
    >>> candidates = torch.tensor([[0, 6], [1, 5], [2, 4], [3, 3], [4, 2]])
    >>> classifier.score_candidates(scenes, pool, candidates).shape
    torch.Size([5, 2])
    """
    options = {"in_keys": in_keys, "out_key": out_key}
    classifier = build(
        "instruction", pair_scorer, spec_source, preset, options, device, seed, overrides
    )
    if init_from is not None:
        start_scorer(classifier.module, init_from, roles)
    return classifier
