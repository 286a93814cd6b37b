"""Initial weights that another network has learned (``init_from``)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ifo_grounding.errors import UserError
from ifo_grounding.networks.grounding import MEANING, GroundedTrunk
from ifo_grounding.networks.scoring import GatedScorer
from ifo_grounding.networks.trunk import GatedTrunk, InstructedNetwork, instructed_network
from ifo_grounding.networks.word_scoring import WordScorer

Parts = list[tuple[nn.Module, nn.Module]]


def started(module: Any, policy: nn.Module | None, roles: bool = False) -> Any:
    """Return a module with what a policy, where one is given, has learned, which it remembers.

    A critic and a reward model get its trunk. A classifier gets what it has learned of words, cells
    and places; of several images it reads the last one as the policy does, the others not yet. Of
    words that are read one by one that is what they look like and which side they name. Which of
    them count for which map is learned anew, unless ``roles`` says otherwise: a policy may hear
    object and target in one map, one after the other, which tells nobody whether both are there.
    """
    if policy is None:
        return module
    source, network = instructed_network(policy), module.module
    trunk = source.trunk
    parts: Parts = []
    widened: Parts = []
    if isinstance(network, InstructedNetwork):
        parts = [(trunk, network.trunk)]
    elif isinstance(trunk, GroundedTrunk) and isinstance(network, WordScorer):
        theirs, own = trunk.words, network.words
        meaning = [(getattr(theirs, name), getattr(own, name)) for name in MEANING]
        parts = [(trunk.appearance, network.appearance), *([(theirs, own)] if roles else meaning)]
        widened = [(trunk.attention, network.attention), (trunk.value, network.value)]
    elif isinstance(trunk, GatedTrunk) and isinstance(network, GatedScorer):
        gated = network.trunk
        parts = [(trunk.instruction, gated.instruction), (trunk.fusion, gated.fusion)]
        widened = [(trunk.image, gated.image)]
    try:
        if source.config.preset != network.config.preset:
            raise RuntimeError
        for given, taken in parts:
            taken.load_state_dict(given.state_dict())
        for given, taken in widened:
            like = taken.state_dict()
            fitted = {
                name: _last(weight, like[name]) for name, weight in given.state_dict().items()
            }
            taken.load_state_dict(fitted)
    except RuntimeError:
        raise UserError(
            f"init_from does not fit: it is {source.config} for {source.shapes}, this is "
            f"{network.config} for {network.shapes}; give both the same preset, sizes and options"
        ) from None
    for _, taken in [*parts, *widened]:
        remember(taken)
    return module


def remember(module: nn.Module) -> None:
    """Let :func:`inherited` return the weights of a module as they are now."""
    copied = {name: weight.detach().clone() for name, weight in module.named_parameters()}
    module.inherited = copied  # type: ignore[assignment]


def inherited(module: nn.Module) -> list[tuple[nn.Parameter, Tensor]]:
    """Return the parameters of a module that were another network's, with what they were then.

    >>> from ifo_grounding.networks import Shapes, make_goal_classifier, make_policy
    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> classifier = make_goal_classifier(shapes, init_from=make_policy(shapes, seed=0))
    >>> all(torch.equal(now, then) for now, then in inherited(classifier))
    True
    """
    found = []
    for part in module.modules():
        for name, then in getattr(part, "inherited", {}).items():
            weight = part.get_parameter(name)
            found.append((weight, then.to(weight.device)))
    return found


def _last(weight: Tensor, like: Tensor) -> Tensor:
    """Return a weight as the last inputs of a larger one, whose first ones count nothing."""
    more = like.shape[1] - weight.shape[1] if like.ndim > 1 else 0
    if more <= 0:
        return weight
    return torch.cat([weight.new_zeros(len(weight), more, *weight.shape[2:]), weight], 1)
