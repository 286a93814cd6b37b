"""The supervised loop and the self-examination loop that the recipes share."""

from ifo_grounding.training.auxiliary import AdversarialUpdates, AuxiliaryImitation
from ifo_grounding.training.checkpoint import Checkpoint
from ifo_grounding.training.pairs import select_pairs
from ifo_grounding.training.run import Run, Stage
from ifo_grounding.training.selection import BestCheckpoint, EarlyStopping, HeldOutAccuracy
from ifo_grounding.training.self_examination import (
    SelfExaminationConfig,
    improve_policy,
    self_examine,
)
from ifo_grounding.training.supervised import FitConfig, fit
from ifo_grounding.training.trials import Trial, successive_halving, trial_seed

__all__ = [
    "AdversarialUpdates",
    "AuxiliaryImitation",
    "BestCheckpoint",
    "Checkpoint",
    "EarlyStopping",
    "FitConfig",
    "HeldOutAccuracy",
    "Run",
    "SelfExaminationConfig",
    "Stage",
    "Trial",
    "fit",
    "improve_policy",
    "select_pairs",
    "self_examine",
    "successive_halving",
    "trial_seed",
]
