"""One picture of a self-examination: learned returns beside true success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ifo_grounding.errors import UserError
from ifo_grounding.report.plots import known
from ifo_grounding.report.theme import PALETTE, add_legend, dress, in_percent, new_panels

PANELS: dict[str, dict[str, str]] = {
    "Learned return and true success": {
        "audit_return": "learned return",
        "audit_success": "true success",
    },
    "True success": {"success": "greedy", "success_sampled": "sampled"},
    "Chosen instructions": {"suitable": "suitable", "served_share": "states served"},
    "Learned rewards against the truth (AUC)": {
        "return_auc": "return: success above failure",
        "action_auc": "reward: expert's action above another",
    },
    "Episode length": {"episode_length": "steps"},
    "Entropy of the policy": {"entropy": "nats"},
}
"""Panels of the picture: the logged metrics of each, with what they are called there."""
SHARES = tuple(PANELS)[:4]
"""Panels in percent."""


def audit_figure(history: Sequence[Mapping[str, float]]) -> Figure:
    """Draw the audit of a self-examination.

    Reward hacking shows in the first panel: the learned return rises, and true success does not.
    Both are measured on the same rollouts of scenes with true instructions.

    Args:
        history: what ``self_examine`` returned, with the metrics of the recipes' audit; metrics
            that an iteration lacks are left out, as are those that are not defined there (an AUC
            where every episode succeeds).

    Raises:
        UserError: where the history holds none of the metrics of the picture.

    >>> rows = [{"step": 1.0, "entropy": 0.5}, {"step": 2.0, "entropy": 0.4, "success": 0.9}]
    >>> [axes.get_title(loc="left") for axes in audit_figure(rows).axes if axes.get_visible()]
    ['True success', 'Entropy of the policy']
    """
    points = {name: known(history, name) for lines in PANELS.values() for name in lines}
    panels = [
        (title, {label: points[name] for name, label in lines.items() if points[name]})
        for title, lines in PANELS.items()
    ]
    panels = [(title, lines) for title, lines in panels if lines]
    if not panels:
        raise UserError("the history holds nothing to audit: was it a self-examination?")
    figure, grid = new_panels(len(panels), 4.4, 2.6)
    for axes, (title, lines) in zip(grid, panels, strict=True):
        _panel(axes, title, lines)
        axes.set_xlim(history[0]["step"] - 0.5, history[-1]["step"] + 0.5)
    return figure


def _panel(axes: Axes, title: str, lines: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Draw one panel: the points of each line, by label."""
    dress(axes, title, "iteration")
    for (label, points), colour in zip(lines.items(), PALETTE, strict=False):
        marker = "o" if len(points) <= 30 else ""
        style: dict[str, Any] = {"linewidth": 1.8, "marker": marker, "ms": 3.5}
        axes.plot(*zip(*points, strict=True), color=colour, label=label, **style)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    if title in SHARES:
        low = min(axes.get_ylim()[0], 0.9)
        top = max(1.0, *(value for points in lines.values() for _, value in points))
        in_percent(axes, low)
        axes.set_ylim(top=top + 0.05 * (top - low))  # a return can exceed 1
    if len(lines) > 1:
        add_legend(axes, loc="best")
