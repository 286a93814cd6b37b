"""Transforms of self-examination: an instruction for every episode, a reward for every step."""

from ifo_grounding.transforms.choosing import Choices, PoolScorer
from ifo_grounding.transforms.goal import GoalReward
from ifo_grounding.transforms.reward import LearnedReward
from ifo_grounding.transforms.sampler import InstructionSampler, NothingSuitableError
from ifo_grounding.transforms.starts import StartingPairs

__all__ = [
    "Choices",
    "GoalReward",
    "InstructionSampler",
    "LearnedReward",
    "NothingSuitableError",
    "PoolScorer",
    "StartingPairs",
]
