"""What is asked: goals, their sentences, numbered scenes, and an expert."""

from ifo_grounding.tasks.goals import (
    MAX_STEPS,
    REASONS,
    SIDES,
    TASKS,
    Goal,
    Plan,
    achieved,
    fulfilled,
    plan,
    verdict,
)
from ifo_grounding.tasks.grammar import HOLDOUTS, N_TEMPLATES, PHRASINGS, SPLITS, Grammar, grammar
from ifo_grounding.tasks.scenes import Scene, SceneOptions
from ifo_grounding.tasks.streams import SceneStream
from ifo_grounding.tasks.vocabulary import VOCABULARY, Vocabulary

__all__ = [
    "HOLDOUTS",
    "MAX_STEPS",
    "N_TEMPLATES",
    "PHRASINGS",
    "REASONS",
    "SIDES",
    "SPLITS",
    "TASKS",
    "VOCABULARY",
    "Goal",
    "Grammar",
    "Plan",
    "Scene",
    "SceneOptions",
    "SceneStream",
    "Vocabulary",
    "achieved",
    "fulfilled",
    "grammar",
    "plan",
    "verdict",
]
