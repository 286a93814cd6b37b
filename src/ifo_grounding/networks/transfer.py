"""Beginning a network with weights that another one has learned."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ifo_grounding.errors import UserError
from ifo_grounding.networks.building import Blueprint
from ifo_grounding.networks.grounding import GroundedTrunk
from ifo_grounding.networks.trunk import InstructedNetwork, Trunk


def trunk_of(policy: nn.Module) -> Trunk | GroundedTrunk:
    """Return the trunk of a policy that ``make_policy`` built.

    >>> from ifo_grounding.networks import Shapes, make_policy
    >>> trunk_of(make_policy(Shapes(image_shape=(3, 48, 48), vocabulary_size=40))).size
    312
    """
    return instructed_network(policy).trunk


def instructed_network(policy: nn.Module) -> InstructedNetwork:
    """Return the network within a policy that ``make_policy`` built."""
    found = [part for part in policy.modules() if isinstance(part, InstructedNetwork)]
    if len(found) != 1:
        raise UserError("this must be a policy built by make_policy")
    return found[0]


def copy_weights(
    parts: Sequence[tuple[nn.Module, nn.Module]],
    source: nn.Module,
    plan: Blueprint,
    widened: Sequence[tuple[nn.Module, nn.Module]] = (),
) -> None:
    """Copy the weights of each pair's first module to its second, which remembers them.

    Args:
        parts: modules of the same kind and sizes.
        widened: modules of which the second may read more images than one, whose inputs lie one
            after the other: it reads the last one as the first module does, the others not yet.
        source: the network that the first modules are from, for the error.
        plan: what the network to begin was built from, for the error.

    Raises:
        UserError: where the weights do not fit.
    """
    try:
        for given, taken in parts:
            taken.load_state_dict(given.state_dict())
        for given, taken in widened:
            own, theirs = taken.state_dict(), given.state_dict()
            fitted = {name: _last(weight, own[name]) for name, weight in theirs.items()}
            taken.load_state_dict(fitted)
        for _, taken in [*parts, *widened]:
            begun = {name: weight.detach().clone() for name, weight in taken.named_parameters()}
            taken.inherited = begun  # type: ignore[assignment]
    except RuntimeError:
        origin: Blueprint | None = getattr(source, "network_config", None)
        described = f"{origin.config} for {origin.shapes}" if origin else "another network"
        raise UserError(
            f"the trunk of init_from does not fit: it is {described}, this is {plan.config} for "
            f"{plan.shapes}; give both the same preset, sizes and options"
        ) from None


def inherited(module: nn.Module) -> list[tuple[nn.Parameter, Tensor]]:
    """Return the parameters of a module that began as another network's, with what they were then.

    >>> from ifo_grounding.networks import Shapes, make_goal_judge, make_policy
    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> judge = make_goal_judge(shapes, init_from=make_policy(shapes, seed=0))
    >>> all(torch.equal(now, then) for now, then in inherited(judge))
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
