"""Options of the baselines."""

from __future__ import annotations

from dataclasses import dataclass

from ifo_grounding.errors import check_numbers, check_range

METHODS = {
    "bc": "record_demonstrations",
    "bco": "imitate",
    "gail": "train_instruction",
    "gail+bc": "train_instruction",
    "gaifo": "train_instruction",
    "agile": "record_demonstrations",
    "agile-chosen": "train_instruction",
    "ours": "self_examine",
    "random": "record_demonstrations",
    "expert": "record_demonstrations",
}
"""Methods of Table 1 and references, and the last stage of a run that each begins with."""


@dataclass
class BaselineConfig:
    """Adversarial methods of ``ifo-grounding run baselines``."""

    frames: int = 2_000_000
    """Steps of the simulator that the policy learns from."""
    steps: int = 10
    """Gradient steps of the discriminator after each iteration."""
    lr: float = 3e-4
    """Learning rate of the discriminator."""
    swapped: bool = True
    """Whether demonstrations with another instruction are negatives, too."""
    entropy: float = 0.01
    """Weight of the policy's entropy bonus."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_range(self, "frames", "steps", least=1)
        check_range(self, "lr", above=0)
        check_range(self, "entropy", least=0)
