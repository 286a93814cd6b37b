"""What is asked: goals, their sentences, numbered scenes, and an expert."""

from ifo_grounding.tasks.goals import (
    REASONS,
    TASKS,
    Goal,
    Plan,
    fulfilled,
    plan,
    verdict,
)
from ifo_grounding.tasks.grammar import N_TEMPLATES, Grammar, grammar
from ifo_grounding.tasks.scenes import Scene, SceneOptions, draw_scenes
from ifo_grounding.tasks.vocabulary import VOCABULARY, Vocabulary

__all__ = [
    "N_TEMPLATES",
    "REASONS",
    "TASKS",
    "VOCABULARY",
    "Goal",
    "Grammar",
    "Plan",
    "Scene",
    "SceneOptions",
    "Vocabulary",
    "draw_scenes",
    "fulfilled",
    "grammar",
    "plan",
    "verdict",
]
