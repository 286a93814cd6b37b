"""A page on which a person watches a trained agent, talks to it and teaches it (extra ``play``)."""

from ifo_grounding.playground.agent import Agent, Played, Suited, taught_in
from ifo_grounding.playground.looking import Recorded, look
from ifo_grounding.playground.teaching import Lesson, Shown, Training
from ifo_grounding.playground.visit import Source, Visit

__all__ = [
    "Agent",
    "Lesson",
    "Played",
    "Recorded",
    "Shown",
    "Source",
    "Suited",
    "Training",
    "Visit",
    "look",
    "taught_in",
]
