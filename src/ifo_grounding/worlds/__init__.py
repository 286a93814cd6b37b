"""Worlds that recipes run in: the library's own, BabyAI, any of Gymnasium, or a person's own class.

A recipe knows :class:`World` alone, so that both phases run on every world.
"""

from ifo_grounding.worlds.babyai import BabyAI
from ifo_grounding.worlds.base import Oracle, World
from ifo_grounding.worlds.grid import Grid, OpenGrid
from ifo_grounding.worlds.gymnasium import Gymnasium

__all__ = ["BabyAI", "Grid", "Gymnasium", "OpenGrid", "Oracle", "World"]
