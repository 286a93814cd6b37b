"""What to do (the paper's action policy), and how well it will go (a critic for GAE)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict.nn import InteractionType, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.data import Categorical as CategoricalSpec
from torchrl.modules import ProbabilisticActor, ValueOperator

from ifo_grounding import keys
from ifo_grounding.networks.building import Blueprint, Shareable, build
from ifo_grounding.networks.shapes import check_categorical
from ifo_grounding.networks.trunk import InstructedNetwork
from ifo_grounding.networks.warm_start import instructed_network, start_trunk

INPUTS: tuple[NestedKey, NestedKey] = (keys.PIXELS, keys.INSTRUCTION)


class Policy(Shareable, ProbabilisticActor):
    """An actor that can be saved for others."""


class Value(Shareable, ValueOperator):
    """A value that can be saved for others."""


def make_policy(
    spec_source: Any,
    preset: str = "strong",
    *,
    in_keys: Sequence[NestedKey] = INPUTS,
    action_key: NestedKey = keys.ACTION,
    logits_key: NestedKey = keys.LOGITS,
    deterministic: bool = False,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> ProbabilisticActor:
    """Build the action policy: an image and an instruction to an action, int64 [*B].

    It samples by default; ``set_exploration_type`` wins over that. It is built in eval mode, in
    which to collect and to evaluate; the supervised losses switch to train mode while they compute.

    Args:
        spec_source: an env, a dataset or a :class:`~ifo_grounding.networks.Shapes`.
        preset: ``"strong"`` or ``"paper"``.
        in_keys: the image, uint8 [*B, C, H, W], and the instruction, int64 [*B, L].
        action_key: where the action goes; its log-probability goes beside it, as TorchRL names it.
        logits_key: where the logits go, float32 [*B, A].
        deterministic: take the likeliest action by default.
        device: where to build it.
        seed: makes the initial weights a function of the seed alone.
        overrides: values of :class:`~ifo_grounding.networks.NetworkConfig` to replace.

    Raises:
        UserError: for an unknown preset or option, sizes that cannot be read, or an environment of
            one-hot actions.

    >>> from tensordict import TensorDict
    >>> from ifo_grounding.networks import Shapes
    >>> policy = make_policy(Shapes(image_shape=(3, 48, 48), vocabulary_size=40), seed=0)
    >>> step = policy(TensorDict({
    ...     "pixels": torch.zeros(2, 3, 48, 48, dtype=torch.uint8),
    ...     "instruction": torch.ones(2, 16, dtype=torch.int64),
    ... }, [2]))
    >>> step["action"].shape, step["action_log_prob"].shape
    (torch.Size([2]), torch.Size([2]))
    """
    check_categorical(spec_source)

    def actor(network: nn.Module, plan: Blueprint) -> Policy:
        kind = InteractionType.DETERMINISTIC if deterministic else InteractionType.RANDOM
        return Policy(
            TensorDictModule(network, in_keys=plan.options["in_keys"], out_keys=[logits_key]),
            in_keys={"logits": logits_key},
            out_keys=[action_key],
            spec=CategoricalSpec(plan.shapes.n_actions, device=device),
            distribution_class=Categorical,
            return_log_prob=True,
            default_interaction_type=kind,
        )

    options = {
        "in_keys": in_keys,
        "action_key": action_key,
        "logits_key": logits_key,
        "deterministic": deterministic,
    }
    return build(
        "policy", InstructedNetwork, spec_source, preset, options, device, seed, overrides, actor
    )


def make_value(
    spec_source: Any,
    preset: str = "strong",
    *,
    init_from: nn.Module | None = None,
    in_keys: Sequence[NestedKey] = INPUTS,
    out_key: NestedKey = keys.STATE_VALUE,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> ValueOperator:
    """Build a critic: an image and an instruction to a value, float32 [*B, 1].

    Args:
        spec_source: an env, a dataset or a :class:`~ifo_grounding.networks.Shapes`.
        preset: ``"strong"`` or ``"paper"``, all without dropout.
        init_from: a policy of the same preset and sizes whose trunk's weights are copied (a warm
            start).
        in_keys: the image, uint8 [*B, C, H, W], and the instruction, int64 [*B, L].
        out_key: where the value goes.
        device: where to build it.
        seed: makes the initial weights a function of the seed alone.
        overrides: values of :class:`~ifo_grounding.networks.NetworkConfig` to replace.

    Raises:
        UserError: for an unknown preset or option, sizes that cannot be read, or a policy whose
            trunk does not fit.

    >>> from ifo_grounding.networks import Shapes
    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> value = make_value(shapes, init_from=make_policy(shapes, seed=0), seed=0)
    >>> value(pixels=torch.zeros(2, 3, 48, 48), instruction=torch.ones(2, 16)).shape
    torch.Size([2, 1])
    """
    options = {"in_keys": in_keys, "out_key": out_key}

    def critic(network: nn.Module, plan: Blueprint) -> Value:
        return Value(network, plan.options["in_keys"], [out_key])

    network = partial(InstructedNetwork, outputs=1)
    value = build("value", network, spec_source, preset, options, device, seed, overrides, critic)
    if init_from is not None:
        start_trunk(value.module, init_from)
    return value


def attention_maps(policy: nn.Module, pixels: Tensor, instruction: Tensor) -> Tensor:
    """Return how each map of a policy weighs the cells of images, in the light of instructions.

    The maps are the word maps of the preset ``strong``, each read as evidence for places and as
    evidence against them, and of ``paper`` what all gates together let through.

    Args:
        policy: built by ``make_policy``.
        pixels: uint8 [N, C, H, W].
        instruction: token ids, int64 [N, L].

    Returns:
        Weights, float32 [N, M, h, w], which sum to 1 over the cells of a map.

    >>> from ifo_grounding.networks import Shapes
    >>> policy = make_policy(Shapes(image_shape=(3, 48, 48), vocabulary_size=40), seed=0)
    >>> words = torch.ones(2, 16, dtype=torch.int64)
    >>> attention_maps(policy, torch.zeros(2, 3, 48, 48), words).shape
    torch.Size([2, 16, 6, 6])
    """
    network = instructed_network(policy)
    image, _ = network.flat_pixels(pixels)
    maps = network.trunk.maps(image, instruction).float()
    return maps.unflatten(-1, network.grid)
