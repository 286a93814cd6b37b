"""Which instruction suits a scene (the paper's instruction module)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import nn

from ifo_grounding import keys
from ifo_grounding.errors import UserError
from ifo_grounding.networks.building import (
    Blueprint,
    blueprint,
    check_keys,
    construct,
    wrap,
)
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.networks.grounding import MEANING, GroundedTrunk
from ifo_grounding.networks.scoring import PairScorer, SentenceScorer
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.networks.transfer import copy_weights, trunk_of
from ifo_grounding.networks.word_scoring import WordScorer


def pair_scorer(shapes: Shapes, config: NetworkConfig, images: int = 1) -> PairScorer:
    """Return the configured network that scores ``images`` images with an instruction."""
    kind = WordScorer if config.matching == "words" else SentenceScorer
    return kind(shapes, config, images)


def begin_with_policy(
    network: PairScorer, policy: nn.Module, plan: Blueprint, roles: bool = False
) -> None:
    """Copy what a policy has learned of words, cells and places; of several images, to the last.

    Of words that are read one by one that is what they look like and which side they name. Which
    of them count for which map is learned anew, unless ``roles`` says otherwise: a policy may hear
    object and target in one map, one after the other, which tells nobody whether both are there.

    Raises:
        UserError: where the weights do not fit.
    """
    trunk = trunk_of(policy)
    if isinstance(trunk, GroundedTrunk) != isinstance(network, WordScorer):
        raise UserError(
            "one of init_from and this network reads word by word (preset 'strong'), the other "
            "reads sentences: give both the same preset, or begin without init_from"
        )
    if isinstance(trunk, GroundedTrunk):
        assert isinstance(network, WordScorer)
        parts: list[tuple[nn.Module, nn.Module]] = [(trunk.looks, network.looks)]
        if roles:
            parts.append((trunk.words, network.words))
        else:
            parts += [
                (getattr(trunk.words, part), getattr(network.words, part)) for part in MEANING
            ]
        widened: list[tuple[nn.Module, nn.Module]] = [
            (trunk.attention, network.attention),
            (trunk.value, network.value),
        ]
    else:
        assert isinstance(network, SentenceScorer)
        parts = [
            (trunk.context, network.context),
            (trunk.instruction, network.instruction),
            (trunk.fusion, network.fusion),
        ]
        if trunk.readout is not None:
            parts.append((trunk.readout, network.readout))
        widened = [(trunk.image, network.image)]
    copy_weights(parts, policy, plan, widened)


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

    ``encode_pixels``, ``encode_instruction``, ``score`` and ``score_all`` of the result score many
    instructions per image cheaply.

    Args:
        spec_source: an env, a dataset or a :class:`~ifo_grounding.networks.Shapes`.
        preset: ``"strong"``, ``"film"`` or ``"paper"``.
        in_keys: the image, uint8 [*B, C, H, W], and the instruction, int64 [*B, L].
        out_key: where the logit goes; the paper's threshold of 0.8 is on its sigmoid.
        init_from: a policy of the same preset and sizes whose weights it begins with. It has
            learned what the words look like, which first frames alone teach slowly (an extension
            of the paper).
        roles: whether it also begins with which words count for which map of that policy, where it
            reads word by word (``"strong"``). Most policies know; one that finds object and target
            by one map, one after the other, does not.
        device: where to build it.
        seed: makes the initial weights a function of the seed alone.
        overrides: values of :class:`~ifo_grounding.networks.NetworkConfig` to replace.

    Raises:
        UserError: for an unknown preset or option, sizes that cannot be read, or a policy that
            does not fit.

    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> classifier = make_instruction_classifier(shapes, seed=0)
    >>> scenes = classifier.encode_pixels(torch.zeros(5, 3, 48, 48, dtype=torch.uint8))
    >>> pool = classifier.encode_instruction(torch.randint(40, (7, 16)))
    >>> classifier.score_all(scenes, pool).shape
    torch.Size([5, 7])
    """
    check_keys(in_keys, ("image", "instruction"))
    options = {"in_keys": list(in_keys), "out_key": out_key}
    plan = blueprint("instruction", spec_source, preset, options, overrides)
    network = construct(pair_scorer, plan, device, seed)
    if init_from is not None:
        begin_with_policy(network, init_from, plan, roles)
    return wrap(network, plan, in_keys, [out_key])
