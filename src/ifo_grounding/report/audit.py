"""One picture of a self-examination: what the learner believes beside what is true."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ifo_grounding.errors import UserError
from ifo_grounding.report.plots import _dress, _figure, _legend, _percent
from ifo_grounding.report.theme import PALETTE

PANELS: dict[str, dict[str, str]] = {
    "What it believes, what is true": {
        "audit_return": "learned return",
        "audit_success": "true success",
    },
    "True success": {"success": "greedy", "success_sampled": "sampled"},
    "Chosen instructions": {"suitable": "suitable", "served_share": "states served"},
    "Do the judges rank rightly (AUC)": {
        "judge_auc": "return: success above failure",
        "action_auc": "reward: expert's action above another",
    },
    "Episode length": {"episode_length": "steps"},
    "Entropy of the policy": {"entropy": "nats"},
}
"""Panels of the picture: the logged metrics of each, with what they are called there."""
SHARES = ("success", "audit_success", "audit_return", "suitable", "judge_auc")


def audit_figure(history: Sequence[Mapping[str, float]]) -> Figure:
    """Draw the audit of a self-examination.

    Reward hacking shows in the first panel: the learned return rises, and true success does not.
    Both are measured on the same rollouts of scenes with true instructions.

    Args:
        history: what ``self_examine`` returned, with the metrics of the recipes' audit; metrics
            that an iteration lacks are left out, as are those that are not defined there (how well
            a judge ranks, where every episode succeeds).

    Raises:
        UserError: where the history holds none of the metrics of the picture.

    >>> rows = [{"step": 1.0, "entropy": 0.5}, {"step": 2.0, "entropy": 0.4, "success": 0.9}]
    >>> [axes.get_title(loc="left") for axes in audit_figure(rows).axes if axes.get_visible()]
    ['True success', 'Entropy of the policy']
    """
    known = {name: _known(history, name) for lines in PANELS.values() for name in lines}
    found = {
        title: {name: label for name, label in lines.items() if known[name]}
        for title, lines in PANELS.items()
    }
    found = {title: lines for title, lines in found.items() if lines}
    if not found:
        raise UserError("the history holds nothing to audit: was it a self-examination?")
    columns = min(2, len(found))
    rows = -(-len(found) // columns)
    figure, grid = _figure(4.4 * columns + 0.4, 2.7 * rows, rows, columns)
    for axes in grid.flat[len(found) :]:
        axes.set_visible(False)
    for axes, (title, lines) in zip(grid.flat, found.items(), strict=False):
        _dress(axes, title, "iteration")
        for (name, label), colour in zip(lines.items(), PALETTE, strict=False):
            marker = "o" if len(known[name]) <= 30 else ""
            axes.plot(
                *zip(*known[name], strict=True),
                color=colour,
                linewidth=1.8,
                marker=marker,
                ms=3.5,
                label=label,
            )
        axes.set_xlim(history[0]["step"] - 0.5, history[-1]["step"] + 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
        if any(name in SHARES for name in lines):
            low = min(axes.get_ylim()[0], 0.9)
            top = max(1.0, *(value for name in lines for _, value in known[name]))
            _percent(axes, low)
            axes.set_ylim(top=top + 0.05 * (top - low))  # a return can exceed 1
        if len(lines) > 1:
            _legend(axes, loc="best")
    return figure


def _known(history: Sequence[Mapping[str, float]], name: str) -> list[tuple[float, float]]:
    """Iterations at which a metric is known, and its values."""
    rows = [(row["step"], row[name]) for row in history if name in row]
    return [(step, value) for step, value in rows if value is not None and np.isfinite(value)]
