"""Every size and choice of a network, in one dataclass, with the values of the presets."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from ifo_grounding.errors import UserError, check_choice, check_numbers

POOLINGS = ("last", "mean", "both")
"""Which states of a GRU make an encoded sentence."""
KINDS = ("inverse", "policy", "value", "instruction", "reward", "goal")
"""The networks of this package."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes and choices of a network.

    >>> NetworkConfig.of("policy", "paper", dropout=0.0).features
    32
    """

    preset: str
    """``"paper"`` (strided convolutions, gated attention), ``"film"`` (patches, FiLM), or
    ``"strong"``: as film, but policy, critic, instruction module and goal judge read word by
    word."""
    features: int
    """Channels of the feature map."""
    conv_layers: int
    """Strided convolutions (``paper``)."""
    patch_size: int | None
    """Pixels per side of a patch (``film``, ``strong``); None means the tile size, or 8."""
    n_blocks: int
    """Residual blocks that modulate the feature map by the instruction (``film``, ``strong``)."""
    kernel: int
    """Cells across that a residual block sees: 1 for the cell alone (``film``, ``strong``)."""
    context: int
    """How far what lies around a cell is seen: residual blocks of kernel 3 before the instruction
    comes in (``film``), convolutions of kernel 3 over forms and word maps, and places read in the
    light of what is seen (``strong``: policy and critic; its judges see one cell around anyway)."""
    heads: int
    """Attention maps that the head reads (``film``, ``strong``)."""
    values: int
    """Values that each attention map reads (``film``, ``strong``)."""
    detectors: int
    """Kinds of cells that the instruction module and the goal judge count (``film``)."""
    matching: str
    """How an instruction meets cells: ``"sentence"``, as one vector, or ``"words"``, each by
    itself (:class:`~ifo_grounding.networks.WordMaps`)."""
    maps: int
    """Maps that words add their evidence to (``matching="words"``)."""
    words: str
    """``"gru"`` (the paper's) or ``"conv"``: how a sentence is encoded."""
    embedding: int
    """Size of a word's embedding."""
    hidden: int
    """Size of the GRU's state each way: half an encoded sentence, a quarter with ``"both"``."""
    dropout: float
    """Dropout rate before each linear layer of the head."""
    head_hidden: tuple[int, ...]
    """Sizes of the head's hidden layers."""
    precision: str | None = None
    """``"fp32"``, ``"bf16"``, or ``"auto"``: bf16 where the hardware computes in it. None leaves it
    to the caller: float32, unless inside ``torch.autocast``."""
    sentence_rate: float = 1.0
    """How fast the sentence's encoder and the gates learn, by the rest (``paper``: 0.1). Their
    weights are kept divided by it, so that an optimiser such as Adam, whose steps do not depend on
    the scale of a gradient, takes smaller ones (an equalised rate, Karras et al. 2018)."""
    sentence_pooling: str = "last"
    """Which states of a GRU (``words="gru"``) make an encoded sentence: the ``"last"`` of each way,
    their ``"mean"`` over words (``paper``), or ``"both"``, side by side."""

    def __post_init__(self) -> None:
        check_choice("preset", self.preset, PRESETS)
        check_choice("matching", self.matching, ("sentence", "words"))
        check_choice("words", self.words, ("gru", "conv"))
        check_choice("sentence_pooling", self.sentence_pooling, POOLINGS)
        check_choice("precision", self.precision, (None, "auto", "fp32", "bf16"))
        self._check_sizes()
        if not 0 < self.sentence_rate <= 1:
            raise UserError(f"sentence_rate must lie in (0, 1], got {self.sentence_rate}")
        if self.sentence_rate != 1 and self.preset != "paper":
            raise UserError("sentence_rate is of the GRU and the gates of preset 'paper' alone")
        if not 0 <= self.dropout < 1:
            raise UserError(f"dropout must lie in [0, 1), got {self.dropout}")
        object.__setattr__(self, "head_hidden", tuple(self.head_hidden))
        if any(size < 1 for size in self.head_hidden):
            raise UserError(f"sizes in head_hidden must be at least 1, got {self.head_hidden}")

    def _check_sizes(self) -> None:
        check_numbers(self)
        by_word = self.matching == "words"
        if by_word and self.preset == "paper":
            raise UserError("matching='words' reads patches: it needs preset 'strong' or 'film'")
        least = {
            **dict.fromkeys(("n_blocks", "context", "heads", "values", "detectors"), 0),
            **dict.fromkeys(("features", "kernel", "embedding"), 1),
            "conv_layers": int(self.preset == "paper"),
            "maps": int(by_word),
            "hidden": 1 + by_word,
        }
        if self.patch_size is not None:
            least["patch_size"] = 1
        for name, lowest in least.items():
            if getattr(self, name) < lowest:
                raise UserError(f"{name} must be at least {lowest}, got {getattr(self, name)}")
        if self.kernel % 2 == 0:
            raise UserError(f"kernel must be odd, for a cell lies in its middle, got {self.kernel}")

    @classmethod
    def of(cls, kind: str, preset: str = "strong", **overrides: Any) -> NetworkConfig:
        """Return the configuration of ``kind`` under ``preset``, with some values replaced.

        Raises:
            UserError: for an unknown kind, preset or name of a value.
        """
        check_choice("kind of network", kind, KINDS)
        check_choice("preset", preset, PRESETS)
        names = [field.name for field in fields(cls) if field.name != "preset"]
        for name in overrides:
            check_choice("option of a network", name, names)
        return cls(preset=preset, **{**PRESETS[preset][kind], **overrides})


_PAPER: dict[str, Any] = {
    "features": 32,
    "conv_layers": 4,
    "patch_size": None,
    "n_blocks": 0,
    "kernel": 1,
    "context": 0,
    "heads": 0,
    "values": 0,
    "detectors": 0,
    "matching": "sentence",
    "maps": 0,
    "words": "gru",
    "embedding": 8,
    "hidden": 64,
    "dropout": 0.25,
    "head_hidden": (128, 64),
    "sentence_rate": 0.1,
    "sentence_pooling": "mean",
}
_FILM: dict[str, Any] = {
    "features": 64,
    "conv_layers": 0,
    "patch_size": None,
    "n_blocks": 2,
    "kernel": 1,
    "context": 0,
    "heads": 8,
    "values": 16,
    "detectors": 32,
    "matching": "sentence",
    "maps": 0,
    "words": "conv",
    "embedding": 32,
    "hidden": 64,
    "dropout": 0.0,
    "head_hidden": (128,),
}
_INVERSE: dict[str, Any] = {**_FILM, "features": 32, "n_blocks": 0, "context": 2}
_WORDS: dict[str, Any] = {**_FILM, "matching": "words", "maps": 8}
PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "paper": {**dict.fromkeys(KINDS, _PAPER), "value": {**_PAPER, "dropout": 0.0}},
    "film": {
        **dict.fromkeys(KINDS, _FILM),
        "inverse": _INVERSE,
    },
    "strong": {
        **dict.fromkeys(KINDS, _FILM),
        "inverse": _INVERSE,
        "policy": _WORDS,
        "value": _WORDS,
        "instruction": _WORDS,
        "goal": _WORDS,
    },
}
"""Values by preset and kind. A critic has no dropout: its targets would be noise."""
