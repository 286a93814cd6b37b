"""How figures look: colours that colour-blind readers can tell apart, and plain axes.

Nothing here touches matplotlib's global state or needs a display.
"""

from __future__ import annotations

import io
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import PercentFormatter

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Okabe and Ito's colours, the clearest first."""
GOOD, BAD, RUNNING = "#009E73", "#D55E00", "#B6BEC7"
"""Of episodes and choices; words say the same."""
PAPER, INK, FAINT, GRID = "#FFFFFF", "#1F2328", "#59636E", "#E4E7EB"


def new_panels(
    count: int, width: float, height: float, columns: int = 2
) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes, each of some inches, so many side by side."""
    columns = min(columns, count)
    rows = -(-count // columns)
    size = (width * columns + 0.4, height * rows + 0.2)
    figure = Figure(figsize=size, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[count:]:
        axes.set_visible(False)
    return figure, list(grid.flat[:count])


def dress(axes: Axes, title: str = "", x: str = "", y: str = "", grid: str = "y") -> None:
    """Give axes a title, labels and a faint grid along ``grid``: x, y, both or none of them."""
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK)
    axes.set_xlabel(x, color=FAINT)
    axes.set_ylabel(y, color=FAINT)
    axes.tick_params(colors=FAINT, length=0, labelsize=9)
    for side, spine in axes.spines.items():
        spine.set_visible(side == "bottom" and grid == "y")
        spine.set_color(FAINT)
    if grid:
        axes.grid(axis=grid, color=GRID, linewidth=0.8)  # type: ignore[arg-type]
    axes.set_axisbelow(True)


def in_percent(axes: Axes, low: float = 0.0, top: float = 1.02) -> None:
    """Show shares on the vertical axis as percentages."""
    axes.set_ylim(low, top)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))


def add_legend(of: Axes | Figure, **options: Any) -> None:
    """Add a legend without a frame; options are matplotlib's."""
    of.legend(frameon=False, labelcolor=INK, fontsize=9, **options)


def without_formulas(figure: Figure) -> None:
    """Show every ``$`` of a figure's texts as it is: instructions and names hold no formulas."""
    for text in figure.findobj(Text):
        text.set_parse_math(False)


def figure_png(figure: Figure) -> bytes:
    """Return a figure as PNG.

    >>> figure_png(new_panels(1, 2.0, 1.0)[0])[1:4]
    b'PNG'
    """
    without_formulas(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    return buffer.getvalue()
