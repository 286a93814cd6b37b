"""Options of the baselines."""

from __future__ import annotations

from dataclasses import dataclass

from ifo_grounding.errors import check_numbers, check_range

METHODS = {
    "bc": "record_demonstrations",
    "bco": "imitate",
    "bco-alpha": "imitate",
    "gail": "train_instruction",
    "gail+bc": "train_instruction",
    "gaifo": "train_instruction",
    "agile": "record_demonstrations",
    "agile-chosen": "train_instruction",
    "lc-rl": "record_demonstrations",
    "ours": "self_examine",
    "random": "record_demonstrations",
    "expert": "record_demonstrations",
}
"""Methods of Table 1 and references, and the last stage of a run that each begins with."""
REFERENCES = {"true_actions": "bc", "demonstrator": "expert"}
"""Methods that ``references=true`` measures beside both phases, by their names in the results."""
UNLEARNED = ("random", "expert")
"""Those that learn nothing, so that every seed does the same in the same scenes."""
READS = {
    "bco-alpha": ("alpha",),
    "lc-rl": ("likelihood_steps",),
    **dict.fromkeys(
        ("gail", "gail+bc", "gaifo", "agile", "agile-chosen"), ("frames", "steps", "lr")
    ),
}
"""Options that a method reads, if it has any."""
PLANNED = ("move", "move-udlr")
"""The tasks of ``lc-rl``, whose plans are of the arm's cells."""


@dataclass
class BaselineConfig:
    """Rivals of Table 1: ``ifo-grounding run baselines``."""

    frames: int = 600_000
    """Steps of the simulator that the policy learns from."""
    steps: int = 10
    """Gradient steps of the discriminator after each iteration."""
    lr: float | None = None
    """Learning rate of the discriminator; by default the method's own."""
    alpha: float = 1.0
    """Of ``bco-alpha``: steps of the policy, by the number of random steps, from which the inverse
    model learns on."""
    likelihood_steps: int = 300
    """Of ``lc-rl``: gradient steps of the reward."""

    def read_by(self, method: str) -> dict[str, float | None]:
        """Return the options that a method reads."""
        return {name: getattr(self, name) for name in READS[method]}

    def __post_init__(self) -> None:
        check_numbers(self)
        check_range(self, "frames", "steps", "likelihood_steps", least=1)
        check_range(self, "lr", "alpha", above=0)
