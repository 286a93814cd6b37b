"""The supervised loop and the self-examination loop that the recipes share."""

from ifo_grounding.training.adversary import Adversary
from ifo_grounding.training.checkpoint import Checkpoint
from ifo_grounding.training.cloning import NothingAcceptedError, accepted, accepted_steps
from ifo_grounding.training.guard import Guard
from ifo_grounding.training.held_out import HeldOut
from ifo_grounding.training.pairs import load_pairs, save_pairs, select_pairs
from ifo_grounding.training.rehearsal import Rehearsal
from ifo_grounding.training.run import Run, Stage
from ifo_grounding.training.selection import Selection, SelectionSchedule
from ifo_grounding.training.self_examination import SelfExaminationConfig, self_examine
from ifo_grounding.training.supervised import FitConfig, fit

__all__ = [
    "Adversary",
    "Checkpoint",
    "FitConfig",
    "Guard",
    "HeldOut",
    "NothingAcceptedError",
    "Rehearsal",
    "Run",
    "Selection",
    "SelectionSchedule",
    "SelfExaminationConfig",
    "Stage",
    "accepted",
    "accepted_steps",
    "fit",
    "load_pairs",
    "save_pairs",
    "select_pairs",
    "self_examine",
]
