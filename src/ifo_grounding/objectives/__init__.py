"""The losses: one LossModule per network, with configurable keys."""

from ifo_grounding.objectives.base import SupervisedLoss
from ifo_grounding.objectives.goal import GoalLoss
from ifo_grounding.objectives.imitation import ImitationLoss
from ifo_grounding.objectives.instruction import InstructionLoss
from ifo_grounding.objectives.inverse import InverseLoss
from ifo_grounding.objectives.pairs import NegativeInstructions
from ifo_grounding.objectives.reward import RewardLoss

__all__ = [
    "GoalLoss",
    "ImitationLoss",
    "InstructionLoss",
    "InverseLoss",
    "NegativeInstructions",
    "RewardLoss",
    "SupervisedLoss",
]
