"""What a network has to know about the world it is built for: a handful of sizes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from tensordict.utils import NestedKey
from torchrl.data import Bounded, Categorical, OneHot

from ifo_grounding import keys
from ifo_grounding.attributes import attribute
from ifo_grounding.channels import channels_last
from ifo_grounding.errors import UserError, at_least_one
from ifo_grounding.networks.config import NetworkConfig
from ifo_grounding.tasks.vocabulary import Vocabulary


@dataclass(frozen=True)
class Shapes:
    """Sizes of images, instructions and actions.

    >>> Shapes(image_shape=(3, 48, 48), vocabulary_size=40)
    Shapes(image_shape=(3, 48, 48), vocabulary_size=40, instruction_length=16, \
n_actions=6, tile_size=None)
    """

    image_shape: tuple[int, int, int]
    """Channels, height and width of an image."""
    vocabulary_size: int
    """Number of token ids, the pad 0 included."""
    instruction_length: int = keys.INSTRUCTION_LENGTH
    """Tokens per instruction, padding included."""
    n_actions: int = keys.N_ACTIONS
    """Number of actions."""
    tile_size: int | None = None
    """Pixels per side of a cell, where the image has cells."""

    def __post_init__(self) -> None:
        if len(self.image_shape) != 3 or min(self.image_shape) < 1:
            raise UserError(
                f"image_shape must be (channels, height, width), got {self.image_shape}"
            )
        if channels_last(self.image_shape):
            raise UserError(
                f"image_shape is (channels, height, width), and {tuple(self.image_shape)} looks "
                "like one whose channels come last: permute images first, an environment's with "
                "torchrl.envs.PermuteTransform((-1, -3, -2))"
            )
        object.__setattr__(self, "image_shape", tuple(map(int, self.image_shape)))
        for name in ("vocabulary_size", "instruction_length", "n_actions"):
            at_least_one(name, getattr(self, name))

    @classmethod
    def of(
        cls,
        source: Any,
        pixels: NestedKey = keys.PIXELS,
        instruction: NestedKey = keys.INSTRUCTION,
    ) -> Shapes:
        """Read the sizes from ``source``.

        Args:
            source: a :class:`Shapes`, a TorchRL env, or anything with the attributes
                ``image_shape`` and ``vocabulary_size`` (a dataset). Attributes named as the fields
                of this class win over an env's specs.

        Raises:
            UserError: where a size can be read from neither an attribute nor a spec, where actions
                are not one of a number each, or images have their channels last.
        """
        if isinstance(source, cls):
            return source
        found = {name: attribute(source, name) for name in cls.__dataclass_fields__}
        for name, value in _from_specs(source, found, pixels, instruction):
            found[name] = value if found[name] is None else found[name]
        for name, hint in (("image_shape", pixels), ("vocabulary_size", instruction)):
            if found[name] is None:
                raise UserError(
                    f"cannot read {name} from {type(source).__name__}: pass an env with "
                    f"{hint!r} in its observation_spec, or a networks.Shapes"
                )
        return cls(**{name: value for name, value in found.items() if value is not None})

    def fit(self, words: object) -> bool:
        """Whether this is a vocabulary whose token ids a network of these sizes reads."""
        size, length = self.vocabulary_size, self.instruction_length
        return isinstance(words, Vocabulary) and len(words) <= size and words.length == length


def check_categorical(source: Any) -> None:
    """Refuse an env of one-hot actions, as TorchRL makes of Gymnasium's: policies give numbers."""
    specs = getattr(source, "full_action_spec", None)
    if specs is not None and any(isinstance(spec, OneHot) for spec in specs.values(True, True)):
        raise UserError(
            "the environment takes one-hot actions, and policies here give their numbers: make it "
            "with categorical_action_encoding=True"
        )


def patch_size(shapes: Shapes, config: NetworkConfig) -> int:
    """Return the side of a patch: as configured, or the side of a tile, or 8 pixels."""
    return config.patch_size or shapes.tile_size or 8


def grid_of(shapes: Shapes, config: NetworkConfig) -> tuple[int, int]:
    """Return the height and width of the feature map of an image."""
    _, height, width = shapes.image_shape
    if config.preset == "strong":
        patch = patch_size(shapes, config)
        return -(-height // patch), -(-width // patch)
    for _ in range(config.conv_layers):
        height, width = (height + 1) // 2, (width + 1) // 2
    return height, width


def _from_specs(
    env: Any, declared: dict[str, Any], pixels: NestedKey, instruction: NestedKey
) -> Iterator[tuple[str, Any]]:
    """Yield names and values of sizes that an env's specs say."""
    observations = getattr(env, "observation_spec", None)
    if observations is None:
        return
    leaves = observations.keys(True, True)
    batch: list[int] | None = None
    if pixels in leaves and declared["image_shape"] is None:
        *batch, channels, height, width = observations[pixels].shape
        yield "image_shape", (channels, height, width)
    if instruction in leaves:
        spec = observations[instruction]
        yield "instruction_length", int(spec.shape[-1])
        yield "vocabulary_size", int(spec.nvec.max()) if hasattr(spec, "nvec") else _count(spec)
    actions: Any = getattr(env, "full_action_spec", None)
    names = [] if actions is None else list(actions.keys(True, True))
    if declared["n_actions"] is None and (keys.ACTION in names or len(names) == 1):
        name = keys.ACTION if keys.ACTION in names else names[0]
        spec = actions[name]
        count, shape = _count(spec), list(spec.shape)
        one = shape[:-1] if isinstance(spec, OneHot) else shape
        if count is None or batch not in (None, one):
            raise UserError(
                f"networks here choose one of a number of actions for each image, and {name!r} is "
                f"{type(spec).__name__} of shape {shape}: make the environment with one "
                "discrete action, 0 to n - 1"
            )
        yield "n_actions", count


def _count(spec: Any) -> int | None:
    """Return how many numbers, from 0 on, a spec allows, None where it is of no such choice."""
    if isinstance(spec, (Categorical, OneHot)) and not hasattr(spec, "nvec"):
        return int(spec.space.n)
    if not isinstance(spec, Bounded) or spec.dtype.is_floating_point or spec.space.low.any():
        return None
    return int(spec.space.high.max()) + 1
