"""Colours of plots, and their dark version."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib.colors import same_color, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Okabe and Ito's colours, the clearest first."""

_ON_DARK = ("#4BA3E3", "#F4843C", "#2EC4A0", "#E6A3CC", "#8CCBF2", "#F5B942")

LIGHT = {"paper": "#FFFFFF", "ink": "#1F2328", "faint": "#59636E", "grid": "#E4E7EB"}
DARK = {"paper": "#161B22", "ink": "#E6EDF3", "faint": "#9DA7B3", "grid": "#2D333B"}
LIGHT |= {f"series {i}": colour for i, colour in enumerate(PALETTE)}
DARK |= {f"series {i}": colour for i, colour in enumerate(_ON_DARK)}


@contextmanager
def in_theme(figure: Figure, theme: str) -> Iterator[None]:
    """Swap the colours of a figure for those of the dark theme, and back."""
    if theme == "light":
        yield
        return
    _swap(figure, LIGHT, DARK)
    try:
        yield
    finally:
        _swap(figure, DARK, LIGHT)


def _swap(figure: Figure, old: Mapping[str, str], new: Mapping[str, str]) -> None:
    def renewed(colour: Any) -> tuple[float, ...] | None:
        red, green, blue, alpha = to_rgba(colour)
        rgb = (red, green, blue)
        role = next((role for role in old if alpha and same_color(rgb, old[role])), None)
        return None if role is None else to_rgba(new[role], alpha)

    for axes in figure.axes:
        # Ticks are rebuilt from these parameters whenever the figure is drawn.
        axes.tick_params(colors=new["faint"], grid_color=new["grid"])
    for artist in figure.findobj():
        for name in ("color", "facecolor", "edgecolor", "markeredgecolor", "markerfacecolor"):
            getter = getattr(artist, f"get_{name}", None)
            if getter is None or (name == "color" and not isinstance(artist, (Text, Line2D))):
                continue
            value = getter()
            if isinstance(value, np.ndarray) and value.ndim == 2:  # a collection: a row per member
                value = value[0] if len(value) == 1 else None
            if value is not None and (colour := renewed(value)):
                getattr(artist, f"set_{name}")(colour)
