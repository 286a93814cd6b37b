"""Rivals as in the paper's Table 1, each with exactly the access it is allowed.

No learner of the method itself imports this package: of observation-only demonstrations it neither
reads actions nor steps from their states.
"""

from ifo_grounding.baselines.access import (
    ActionDemonstrations,
    SteppableActionDemonstrations,
    SteppableDemonstrations,
)
from ifo_grounding.baselines.adversarial import (
    AGILE,
    GAIL,
    Adversary,
    ChangeNetwork,
    ChosenAGILE,
    DiscriminatorLoss,
    GAIfO,
)
from ifo_grounding.baselines.bco import steps_of_policy
from ifo_grounding.baselines.lc_rl import LCRL
from ifo_grounding.baselines.rewards import AbsorbingState, DiscriminatorReward, StopReward

__all__ = [
    "AGILE",
    "GAIL",
    "LCRL",
    "AbsorbingState",
    "ActionDemonstrations",
    "Adversary",
    "ChangeNetwork",
    "ChosenAGILE",
    "DiscriminatorLoss",
    "DiscriminatorReward",
    "GAIfO",
    "SteppableActionDemonstrations",
    "SteppableDemonstrations",
    "StopReward",
    "steps_of_policy",
]
