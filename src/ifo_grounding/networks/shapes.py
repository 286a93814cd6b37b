"""What a network has to know about the world it is built for: a handful of sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict.utils import NestedKey
from torchrl.data import Bounded, Categorical, OneHot, Unbounded

from ifo_grounding import keys
from ifo_grounding.attributes import attribute
from ifo_grounding.errors import UserError
from ifo_grounding.networks.config import NetworkConfig

MOST_CHANNELS = 4
"""Of a picture: red, green, blue and opacity. No picture is so narrow."""


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
        channels, _, width = self.image_shape
        if width <= MOST_CHANNELS < channels:
            raise UserError(
                f"image_shape is (channels, height, width), and {tuple(self.image_shape)} looks "
                "like one whose channels come last: permute images first, an environment's with "
                "torchrl.envs.PermuteTransform((-1, -3, -2))"
            )
        object.__setattr__(self, "image_shape", tuple(map(int, self.image_shape)))
        for name in ("vocabulary_size", "instruction_length", "n_actions"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 1:
                raise UserError(f"{name} must be a positive integer, got {getattr(self, name)!r}")

    @classmethod
    def of(
        cls,
        source: Any,
        pixels: NestedKey = keys.PIXELS,
        instruction: NestedKey = keys.INSTRUCTION,
        action: NestedKey = keys.ACTION,
    ) -> Shapes:
        """Read the sizes from ``source``.

        Args:
            source: a :class:`Shapes`, a TorchRL env, or anything with the attributes
                ``image_shape`` and ``vocabulary_size`` (a dataset). Attributes named as the fields
                of this class win over an env's specs.
            pixels: where an env's spec describes images.
            instruction: where an env's spec describes instructions.
            action: where an env's spec describes actions; an env's only action has any name.

        Raises:
            UserError: where a size can be read from neither an attribute nor a spec, where actions
                are not one of a number each, or images have their channels last.
        """
        if isinstance(source, cls):
            return source
        observations = getattr(source, "observation_spec", None)
        found = {name: attribute(source, name) for name in cls.__dataclass_fields__}
        if observations is not None:
            for name, value in _from_specs(source, observations, pixels, instruction, action):
                found[name] = value if found[name] is None else found[name]
        for name, hint in (("image_shape", pixels), ("vocabulary_size", instruction)):
            if found[name] is None:
                raise UserError(
                    f"cannot read {name} from {type(source).__name__}: pass an env with "
                    f"{hint!r} in its observation_spec, or a networks.Shapes"
                )
        found["image_shape"] = tuple(int(size) for size in found["image_shape"])
        return cls(**{name: value for name, value in found.items() if value is not None})


def check_categorical(source: Any) -> None:
    """Refuse an environment of one-hot actions, for policies here give their numbers.

    Raises:
        UserError: on one, as TorchRL's wrappers of Gymnasium are by default.
    """
    specs = getattr(source, "full_action_spec", None)
    if specs is not None and any(isinstance(spec, OneHot) for spec in specs.values(True, True)):
        raise UserError(
            "the environment takes one-hot actions, and policies here give their numbers: make it "
            "with categorical_action_encoding=True"
        )


def patch_size(shapes: Shapes, config: NetworkConfig) -> int:
    """Return the side of a patch: as configured, or the side of a tile, or 8 pixels."""
    return config.patch_size or shapes.tile_size or 8


def _from_specs(
    env: Any, observations: Any, pixels: NestedKey, instruction: NestedKey, action: NestedKey
) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    leaves = observations.keys(True, True)
    if pixels in leaves:
        found.append(("image_shape", tuple(observations[pixels].shape[-3:])))
    if instruction in leaves:
        spec = observations[instruction]
        found.append(("instruction_length", int(spec.shape[-1])))
        found.append(("vocabulary_size", _count(spec)))
    actions = getattr(env, "full_action_spec", None)
    if actions is not None and attribute(env, "n_actions") is None:
        names = list(actions.keys(True, True))
        if action in names or len(names) == 1:
            name = action if action in names else names[0]
            batch = tuple(observations[pixels].shape[:-3]) if pixels in leaves else None
            found.append(("n_actions", _count_actions(name, actions[name], batch)))
    return found


def _count_actions(name: NestedKey, spec: Any, batch: tuple[int, ...] | None) -> int:
    """Return of how many actions an environment takes one at a time; ``batch`` is its images'."""
    count: int | None = None
    if isinstance(spec, (Categorical, OneHot)) and not hasattr(spec, "nvec"):
        count = int(spec.space.n)
    elif isinstance(spec, Bounded) and not spec.dtype.is_floating_point:
        count = _count(spec) if bool((spec.space.low == 0).all()) else None
    shape = tuple(spec.shape[:-1] if isinstance(spec, OneHot) else spec.shape)
    if count is None or batch not in (None, shape):
        raise UserError(
            f"networks here choose one of a number of actions for each image, and {name!r} is "
            f"{type(spec).__name__} of shape {list(spec.shape)}: make the environment with one "
            "discrete action, 0 to n - 1"
        )
    return count


def _count(spec: Any) -> int | None:
    """Return how many values a discrete or bounded integer spec allows, None if unbounded."""
    if hasattr(spec, "nvec"):
        return int(spec.nvec.max())
    space = getattr(spec, "space", None)
    n = getattr(space, "n", None)
    if n is not None:
        return int(n)
    high = getattr(space, "high", None)
    if high is None or spec.dtype.is_floating_point or isinstance(spec, Unbounded):
        return None
    return int(high.max()) + 1
