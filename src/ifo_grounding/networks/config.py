"""Every size and choice of a network, in one dataclass, with the values of the presets."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from ifo_grounding.errors import UserError, check_choice, check_numbers, check_range

INPUTS = {
    "inverse": ("image", "next image"),
    "policy": ("image", "instruction"),
    "value": ("image", "instruction"),
    "instruction": ("image", "instruction"),
    "reward": ("image", "instruction", "action"),
    "goal": ("first image", "image", "instruction"),
}
"""The networks of this package, and what each reads, in the order of its ``in_keys``."""
ONLY_IN = {
    **dict.fromkeys(("conv_layers", "embedding", "sentence_rate", "sentence_pooling"), "paper"),
    **dict.fromkeys(("patch_size", "context", "heads", "values", "maps"), "strong"),
}
"""Options of one preset alone."""
MOST_FEATURES, MOST_LAYERS = 1 << 16, 100
"""Bounds of sizes and depths, far above what learns."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes and choices of a network.

    >>> NetworkConfig.of("policy", "paper", dropout=0.0).features
    32
    """

    preset: str
    """``"paper"`` (strided convolutions, a GRU, gated attention) or ``"strong"`` (one patch for
    each cell, and instructions that are read word by word)."""
    features: int
    """Channels of the feature map."""
    hidden: int
    """Size of the GRU's state each way (``paper``), or of what is read around each word
    (``strong``)."""
    head_hidden: tuple[int, ...]
    """Sizes of the head's hidden layers."""
    dropout: float = 0.0
    """Dropout rate before each linear layer of the head."""
    conv_layers: int = 4
    """Strided convolutions (``paper``)."""
    embedding: int = 8
    """Size of a word's embedding (``paper``)."""
    sentence_rate: float = 0.1
    """How fast the sentence's encoder and the gates learn, relative to the rest (``paper``). Their
    weights are kept divided by it, so that an optimiser such as Adam, whose steps do not depend on
    the scale of a gradient, takes smaller ones (an equalised rate, Karras et al. 2018)."""
    sentence_pooling: str = "mean"
    """Which states of the GRU make an encoded sentence (``paper``): their ``"mean"`` over words, or
    the ``"last"`` of each way."""
    patch_size: int | None = None
    """Pixels per side of a patch (``strong``); None means the tile size, or 8."""
    context: int = 0
    """Layers that let a cell see its neighbours (``strong``): residual blocks of the inverse model;
    in policy, critic and reward model convolutions over forms and word maps, with which places are
    also read relative to what is seen. The classifiers always see one cell around,
    whatever this is. What begins with a policy's weights has the policy's."""
    heads: int = 8
    """Attention maps that read no words (``strong``)."""
    values: int = 16
    """Values that each attention map reads (``strong``)."""
    maps: int = 8
    """Maps that words add their evidence to (``strong``)."""

    def __post_init__(self) -> None:
        check_choice("preset", self.preset, PRESETS)
        check_choice("sentence_pooling", self.sentence_pooling, ("last", "mean"))
        check_numbers(self)
        sizes = ("features", "hidden", "conv_layers", "embedding", "patch_size", "maps")
        check_range(self, *sizes, least=1, most=MOST_FEATURES)
        check_range(self, "context", "heads", "values", "dropout", least=0, most=MOST_FEATURES)
        check_range(self, "conv_layers", "context", most=MOST_LAYERS)
        check_range(self, "sentence_rate", above=0, most=1)
        if self.dropout >= 1:
            raise UserError(f"dropout must be below 1, got {self.dropout}")
        object.__setattr__(self, "head_hidden", tuple(self.head_hidden))
        if any(not 1 <= size <= MOST_FEATURES for size in self.head_hidden):
            raise UserError(f"head_hidden must be 1..{MOST_FEATURES}, got {self.head_hidden}")
        for field in fields(self):
            only = ONLY_IN.get(field.name, self.preset)
            if only != self.preset and getattr(self, field.name) != field.default:
                raise UserError(
                    f"{field.name} is an option of preset {only!r} alone, and this network is of "
                    f"{self.preset!r}: leave it out"
                )

    @classmethod
    def of(cls, kind: str, preset: str = "strong", **overrides: Any) -> NetworkConfig:
        """Return the configuration of ``kind`` under ``preset``, with some values replaced."""
        check_choice("kind of network", kind, INPUTS)
        check_choice("preset", preset, PRESETS)
        names = [field.name for field in fields(cls) if field.name != "preset"]
        for name in overrides:
            check_choice("option of a network", name, names)
        chosen = {**PRESETS[preset], **SPECIAL.get((preset, kind), {}), **overrides}
        return cls(preset=preset, **chosen)


PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"features": 32, "hidden": 64, "head_hidden": (128, 64), "dropout": 0.25},
    "strong": {"features": 64, "hidden": 32, "head_hidden": (128,)},
}
"""Values by preset; the other fields keep their defaults."""
SPECIAL: dict[tuple[str, str], dict[str, Any]] = {
    ("paper", "value"): {"dropout": 0.0},  # a critic's targets would be noise
    ("strong", "inverse"): {"features": 32, "context": 2},
}
"""Values of one kind of network."""


@dataclass
class NetworksConfig:
    """Values of ``networks.NetworkConfig`` for all networks of a run; null leaves the preset's."""

    features: int | None = None
    """Channels of the feature map."""
    dropout: float | None = None
    """Dropout rate before each linear layer of the head."""
    sentence_rate: float | None = None
    """How fast the GRU and the gates learn, by the rest (``paper``)."""
    sentence_pooling: str | None = None
    """States of the GRU that make an encoded sentence: ``mean`` or ``last`` (``paper``)."""

    def __post_init__(self) -> None:
        check_range(self, "features", least=1, most=4096)  # a run's networks are all as wide
        NetworkConfig.of("policy", "paper", **self.changed())  # which has them all

    def changed(self) -> dict[str, Any]:
        """Return the values that are not the preset's."""
        return {name: value for name, value in vars(self).items() if value is not None}
