"""Measuring what was learned, each number with its interval.

Evaluation reads the truth (scenes, goals, rewards); learners never import it.
"""

from ifo_grounding.evaluation.endings import Endings, compare_endings, episode_endings
from ifo_grounding.evaluation.labels import LabelAccuracy, label_accuracy
from ifo_grounding.evaluation.probes import Probe, Probes, probe
from ifo_grounding.evaluation.recording import Episode, record_episodes
from ifo_grounding.evaluation.reward import (
    ReturnAudit,
    RewardAudit,
    return_correlation,
    reward_audit,
)
from ifo_grounding.evaluation.success import SuccessResult, compare_success, success_rate
from ifo_grounding.evaluation.suitability import (
    SuitabilityResult,
    judged_choices,
    suitable_rate,
)
from ifo_grounding.evaluation.tracing import Trace, trace_episode
from ifo_grounding.evaluation.words import WordEvidence, word_evidence
from ifo_grounding.modules import evaluating
from ifo_grounding.stats import (
    Difference,
    Estimate,
    Rate,
    auc,
    correlation,
    holm,
    paired_difference,
    two_level_bootstrap,
    wilson,
)

__all__ = [
    "Difference",
    "Endings",
    "Episode",
    "Estimate",
    "LabelAccuracy",
    "Probe",
    "Probes",
    "Rate",
    "ReturnAudit",
    "RewardAudit",
    "SuccessResult",
    "SuitabilityResult",
    "Trace",
    "WordEvidence",
    "auc",
    "compare_endings",
    "compare_success",
    "correlation",
    "episode_endings",
    "evaluating",
    "holm",
    "judged_choices",
    "label_accuracy",
    "paired_difference",
    "probe",
    "record_episodes",
    "return_correlation",
    "reward_audit",
    "success_rate",
    "suitable_rate",
    "trace_episode",
    "two_level_bootstrap",
    "wilson",
    "word_evidence",
]
