"""Rivals of the paper's Table 1, each with exactly the access it is allowed.

Nothing of the method itself imports this package: a learner of observation-only demonstrations
neither reads their actions nor steps from their states.
"""

from ifo_grounding.baselines.access import ActionDemonstrations, SteppableDemonstrations
from ifo_grounding.baselines.adversarial import (
    AGILE,
    GAIL,
    Adversary,
    ChosenAGILE,
    DiscriminatorLoss,
    DiscriminatorReward,
    GAIfO,
)

__all__ = [
    "AGILE",
    "GAIL",
    "ActionDemonstrations",
    "Adversary",
    "ChosenAGILE",
    "DiscriminatorLoss",
    "DiscriminatorReward",
    "GAIfO",
    "SteppableDemonstrations",
]
