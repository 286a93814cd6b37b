"""The six ``make_*`` functions, and the one builder behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from tensordict.nn import InteractionType, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.data import Categorical as CategoricalSpec
from torchrl.modules import ProbabilisticActor, ValueOperator

from ifo_grounding import keys, seeding
from ifo_grounding.attributes import attribute
from ifo_grounding.errors import UserError
from ifo_grounding.networks.base import read_codes
from ifo_grounding.networks.config import INPUTS, NetworkConfig
from ifo_grounding.networks.inverse import InverseNetwork
from ifo_grounding.networks.scoring import GatedScorer, PairScorer
from ifo_grounding.networks.shapes import Shapes, check_categorical, patch_size
from ifo_grounding.networks.trunk import InstructedNetwork, RewardNetwork, instructed_network
from ifo_grounding.networks.warm_start import started
from ifo_grounding.networks.word_scoring import WordScorer

IMAGE_AND_WORDS: tuple[NestedKey, NestedKey] = (keys.PIXELS, keys.INSTRUCTION)


@dataclass(frozen=True)
class Blueprint:
    """Everything that ``load`` needs to build a network again, but for its weights."""

    kind: str
    shapes: Shapes
    config: NetworkConfig
    options: dict[str, Any]
    """Keyword arguments of its ``make_*`` function: keys and the like."""


def pair_scorer(shapes: Shapes, config: NetworkConfig, images: int = 1) -> PairScorer:
    """Return the preset's network that scores ``images`` images with an instruction."""
    kind = GatedScorer if config.preset == "paper" else WordScorer
    return kind(shapes, config, images)


NETWORKS: dict[str, Callable[[Shapes, NetworkConfig], nn.Module]] = {
    "inverse": InverseNetwork,
    "policy": InstructedNetwork,
    "value": partial(InstructedNetwork, outputs=1),
    "instruction": pair_scorer,
    "reward": RewardNetwork,
    "goal": partial(pair_scorer, images=2),
}


def build(
    kind: str,
    source: Any,
    preset: str,
    options: dict[str, Any],
    device: torch.device | str | None,
    seed: int | None,
    overrides: dict[str, Any],
    init_from: nn.Module | None = None,
    wrap: Callable[..., Any] = TensorDictModule,
    roles: bool = False,
) -> Any:
    """Build a network in eval mode, its weights channels last: convolutions are twice as fast so.

    ``options`` are the keyword arguments of the ``make_*`` function that are not named here, and
    ``wrap`` makes what is returned of the network, its ``in_keys`` and its ``out_keys``.
    """
    in_keys, inputs = options["in_keys"], INPUTS[kind]
    if isinstance(in_keys, str) or len(in_keys) != len(inputs):
        raise UserError(
            f"in_keys must be {len(inputs)} keys ({', '.join(inputs)}), got {in_keys!r}"
        )
    options = {**options, "in_keys": list(in_keys)}
    read = dict(zip(inputs, in_keys, strict=True))
    shapes = Shapes.of(source, read["image"], read.get("instruction", keys.INSTRUCTION))
    if init_from is not None and (policy := instructed_network(init_from).config).preset == preset:
        overrides = {"context": policy.context, **overrides}  # it sees as far as its policy
    config = NetworkConfig.of(kind, preset, **overrides)
    if preset == "strong":
        config = replace(config, patch_size=patch_size(shapes, config))
    with torch.random.fork_rng(devices=[], enabled=seed is not None):
        if seed is not None:
            torch.default_generator.manual_seed(seeding.derive(seed, "networks", kind))
        built = NETWORKS[kind](shapes, config).eval().to(torch.device(device or "cpu"))
    built = built.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    module = wrap(built, options["in_keys"], [options.get("out_key")])
    module.network_config = Blueprint(kind, shapes, config, options)
    if isinstance(tiles := attribute(source, "tiles"), Tensor):
        read_codes(module, tiles)
    words = attribute(source, "vocabulary")
    module.vocabulary = words if shapes.fit(words) else None
    return started(module.eval(), init_from, roles)


def make_inverse(
    spec_source: Any,
    preset: str = "strong",
    *,
    in_keys: Sequence[NestedKey] = (keys.PIXELS, keys.NEXT_PIXELS),
    out_key: NestedKey = keys.LOGITS,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> TensorDictModule:
    """Build the inverse model: two images to logits of the actions, float32 [*B, A].

    >>> inverse = make_inverse(Shapes(image_shape=(3, 48, 48), vocabulary_size=40), seed=0)
    >>> frame = torch.zeros(2, 3, 48, 48, dtype=torch.uint8)
    >>> inverse(pixels=frame, next_pixels=frame).shape
    torch.Size([2, 6])
    """
    options = {"in_keys": in_keys, "out_key": out_key}
    return build("inverse", spec_source, preset, options, device, seed, overrides)


def make_policy(
    spec_source: Any,
    preset: str = "strong",
    *,
    in_keys: Sequence[NestedKey] = IMAGE_AND_WORDS,
    action_key: NestedKey = keys.ACTION,
    logits_key: NestedKey = keys.LOGITS,
    deterministic: bool = False,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> ProbabilisticActor:
    """Build the policy: an image and an instruction to an action, int64 [*B].

    It samples by default; ``set_exploration_type`` wins over that.

    Args:
        action_key: where the action goes; its log-probability goes beside it, as TorchRL names it.
        logits_key: where the logits go, float32 [*B, A].
        deterministic: take the likeliest action by default.

    Raises:
        UserError: for an environment of one-hot actions.

    >>> policy = make_policy(Shapes(image_shape=(3, 48, 48), vocabulary_size=40), seed=0)
    >>> image, words = torch.zeros(2, 3, 48, 48, dtype=torch.uint8), torch.ones(2, 16).long()
    >>> logits, action, log_prob = policy(pixels=image, instruction=words)
    >>> logits.shape, action.shape, log_prob.shape
    (torch.Size([2, 6]), torch.Size([2]), torch.Size([2]))
    """
    check_categorical(spec_source)

    def actor(network: InstructedNetwork, *_: Any) -> ProbabilisticActor:
        kind = InteractionType.DETERMINISTIC if deterministic else InteractionType.RANDOM
        return ProbabilisticActor(
            TensorDictModule(network, list(in_keys), [logits_key]),
            in_keys={"logits": logits_key},
            out_keys=[action_key],
            spec=CategoricalSpec(network.shapes.n_actions, device=device),
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
    return build("policy", spec_source, preset, options, device, seed, overrides, wrap=actor)


def make_value(
    spec_source: Any,
    preset: str = "strong",
    *,
    init_from: nn.Module | None = None,
    in_keys: Sequence[NestedKey] = IMAGE_AND_WORDS,
    out_key: NestedKey = keys.STATE_VALUE,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> ValueOperator:
    """Build a critic: an image and an instruction to a value, float32 [*B, 1].

    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> value = make_value(shapes, init_from=make_policy(shapes, seed=0), seed=0)
    >>> value(pixels=torch.zeros(2, 3, 48, 48), instruction=torch.ones(2, 16).long()).shape
    torch.Size([2, 1])
    """
    options = {"in_keys": in_keys, "out_key": out_key}
    return build(
        "value",
        spec_source,
        preset,
        options,
        device,
        seed,
        overrides,
        init_from,
        wrap=ValueOperator,
    )


def make_instruction_classifier(
    spec_source: Any,
    preset: str = "strong",
    *,
    in_keys: Sequence[NestedKey] = IMAGE_AND_WORDS,
    out_key: NestedKey = keys.SUITABILITY,
    init_from: nn.Module | None = None,
    roles: bool = False,
    device: torch.device | str | None = None,
    seed: int | None = None,
    **overrides: Any,
) -> TensorDictModule:
    """Build the instruction classifier: an image and an instruction to a logit [*B, 1].

    ``encode_scenes``, ``encode_instruction`` and ``score_candidates`` of the result score many
    instructions per image cheaply.

    Args:
        out_key: where the logit goes; the paper's threshold of 0.8 is on its sigmoid.
        init_from: a policy (an extension of the paper). It has learned what the words look like,
            which first frames alone teach slowly.
        roles: whether to copy as well which words count for which map of that policy (``strong``).
            Most policies know; one that finds object and target by one map, one after the other,
            does not.

    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> classifier = make_instruction_classifier(shapes, seed=0)
    >>> scenes = classifier.encode_scenes(torch.zeros(5, 3, 48, 48, dtype=torch.uint8))
    >>> pool = classifier.encode_instruction(torch.randint(40, (7, 16)))
    >>> candidates = torch.tensor([[0, 6], [1, 5], [2, 4], [3, 3], [4, 2]])
    >>> classifier.score_candidates(scenes, pool, candidates).shape
    torch.Size([5, 2])
    """
    options = {"in_keys": in_keys, "out_key": out_key}
    return build(
        "instruction", spec_source, preset, options, device, seed, overrides, init_from, roles=roles
    )


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

    An extension of the paper, which assumes that demonstrations end in success. Its halves
    (``encode_scenes`` of both images, ...) work as those of the instruction classifier.

    Args:
        init_from: a policy: the classifier then sees nothing of the first image, until it learns
            to.

    >>> shapes = Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    >>> classifier = make_goal_classifier(shapes, seed=0)
    >>> frame = torch.zeros(2, 3, 48, 48, dtype=torch.uint8)
    >>> classifier(initial_pixels=frame, pixels=frame, instruction=torch.ones(2, 16).long()).shape
    torch.Size([2, 1])
    """
    options = {"in_keys": in_keys, "out_key": out_key}
    return build("goal", spec_source, preset, options, device, seed, overrides, init_from)


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
    """Build the reward model: an image, an instruction and an action to a logit [*B, 1].

    ``all_actions(pixels, instruction)`` of the result scores every action at once, [*B, A].

    Args:
        init_from: a policy (an extension of the paper). Self-examination leads it to what its
            reward model likes best, so that this has to know as much.

    >>> rwd = make_reward_model(Shapes(image_shape=(3, 48, 48), vocabulary_size=40), seed=0)
    >>> image, words = torch.zeros(2, 3, 48, 48, dtype=torch.uint8), torch.ones(2, 16).long()
    >>> rwd(pixels=image, instruction=words, action=torch.tensor([0, 5])).shape
    torch.Size([2, 1])
    """
    options = {"in_keys": in_keys, "out_key": out_key}
    return build("reward", spec_source, preset, options, device, seed, overrides, init_from)
