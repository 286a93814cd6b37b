"""Measuring what was learned, each number with its interval.

Evaluation reads the truth (scenes, goals, rewards); learners never import it.
"""

from ifo_grounding.evaluation.endings import Endings, compare_endings, episode_endings
from ifo_grounding.evaluation.labels import LabelAccuracy, label_accuracy
from ifo_grounding.evaluation.recording import Episode, record_episodes
from ifo_grounding.evaluation.reward import (
    ReturnAudit,
    RewardAudit,
    return_audit,
    reward_audit,
)
from ifo_grounding.evaluation.success import SuccessResult, compare_success, success_rate
from ifo_grounding.evaluation.suitability import SuitabilityResult, suitable_rate
from ifo_grounding.evaluation.tracing import Trace, trace_episode

__all__ = [
    "Endings",
    "Episode",
    "LabelAccuracy",
    "ReturnAudit",
    "RewardAudit",
    "SuccessResult",
    "SuitabilityResult",
    "Trace",
    "compare_endings",
    "compare_success",
    "episode_endings",
    "label_accuracy",
    "record_episodes",
    "return_audit",
    "reward_audit",
    "success_rate",
    "suitable_rate",
    "trace_episode",
]
