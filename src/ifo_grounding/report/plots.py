"""Plots as matplotlib figures: ``figure.savefig`` or :func:`figure_png` writes one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter
from scipy.ndimage import uniform_filter1d

from ifo_grounding.errors import UserError
from ifo_grounding.report.theme import (
    FAINT,
    PALETTE,
    add_legend,
    dress,
    in_percent,
    new_figure,
    new_panels,
)
from ifo_grounding.stats import Rate

SHARES = ("accuracy", "probability", "removed", "share", "stopped", "success", "sampled")
"""Last words of the names of metrics that are shares, and drawn in percent."""
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
IN_PERCENT = tuple(PANELS)[:4]
"""Panels in percent."""
LABELS_APART = 0.1
"""Share of an axis that two of its labels keep between them."""


def known(history: Sequence[Mapping[str, float | None]], name: str) -> list[tuple[float, float]]:
    """Return the steps at which a metric is known, and its values there.

    >>> known([{"step": 1, "loss": 2.0}, {"step": 2, "loss": None}, {"step": 3}], "loss")
    [(1, 2.0)]
    """
    rows = [(row["step"], row[name]) for row in history if name in row]
    return [(x, y) for x, y in rows if x is not None and y is not None and math.isfinite(y)]


def training_curves(
    history: Sequence[Mapping[str, float | None]],
    names: Sequence[str] | None = None,
) -> Figure:
    """Draw one small plot per metric: every value faintly, their running mean on top.

    The mean is over a fiftieth of the values.

    Args:
        history: what was logged, as :func:`~ifo_grounding.training.fit` returns it: a row per
            step with ``step`` and metrics. Values that are None or not finite are left out.
        names: which metrics, in which order; all where None.

    Raises:
        UserError: where a name was not logged.

    >>> figure = training_curves([{"step": step, "loss": 3.0 - step} for step in range(3)])
    >>> figure.axes[0].get_title(loc="left")
    'loss'
    """
    logged = [name for name in dict.fromkeys(n for row in history for n in row) if name != "step"]
    chosen = logged if names is None else list(names)
    series = {name: known(history, name) for name in chosen}
    missing = [name for name in chosen if name not in logged]
    if missing or not chosen:
        raise UserError(f"no metric {missing or ''}: logged were {', '.join(logged) or 'none'}")
    figure, panels = new_panels(len(chosen), 4.2, 2.5)
    for axes, (name, points) in zip(panels, series.items(), strict=True):
        _curve(axes, name, points)
    return figure


def _curve(axes: Axes, name: str, points: Sequence[tuple[float, float]]) -> None:
    dress(axes, name, "step")
    if not points:
        return
    span = max(1, len(points) // 50)
    steps, values = zip(*points, strict=True)
    if span > 1:
        axes.plot(steps, values, color=PALETTE[4], alpha=0.45, linewidth=0.8)
    marker = "o" if len(values) <= 30 else ""
    mean = uniform_filter1d(np.asarray(values), span, mode="nearest")
    axes.plot(steps, mean, color=PALETTE[0], linewidth=1.8, marker=marker, ms=3.5)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    if name.rpartition("_")[2] in SHARES and max(values) > 0.1:
        in_percent(axes)


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
    if title in IN_PERCENT:
        low = min(axes.get_ylim()[0], 0.9)
        top = max(1.0, *(value for points in lines.values() for _, value in points))
        in_percent(axes, low)
        axes.set_ylim(top=top + 0.05 * (top - low))  # a return can exceed 1
    if len(lines) > 1:
        add_legend(axes, loc="best")


def rates_by_number(
    panels: Mapping[str, Mapping[str, Mapping[int, Rate]]],
    *,
    references: Mapping[str, Mapping[str, float]] | None = None,
) -> Figure:
    """Draw rates against the number of demonstrations, with intervals, one panel per group.

    Args:
        panels: title of the panel -> {name of the curve: {number: rate}}.
        references: title of the panel -> {name: rate}, each drawn as a dashed line across.

    >>> from ifo_grounding.stats import wilson
    >>> curves = {"phase 1": {500: wilson(60, 100), 2000: wilson(80, 100)}}
    >>> figure = rates_by_number({"move": curves}, references={"move": {"paper": 0.766}})
    >>> figure.axes[0].get_xscale()
    'log'
    """
    names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
    every = [curve for curves in panels.values() for curve in curves.values()]
    if not any(every):
        raise UserError("rates_by_number needs at least one curve with one rate")
    numbers = sorted({number for curve in every for number in curve})
    lines = [rate for panel in (references or {}).values() for rate in panel.values()]
    low = min([*lines, *(rate.low for curve in every for rate in curve.values())])
    figure, grid = new_panels(len(panels), 3.2, 3.0, columns=3)
    for axes, (title, curves) in zip(grid, panels.items(), strict=True):
        dress(axes, title, "demonstrations")
        axes.set_xscale("log")
        for name, curve in curves.items():
            place = names.index(name)
            aside = 1 + 0.03 * place  # so that no interval hides another
            points = [(aside * number, rate) for number, rate in sorted(curve.items())]
            _with_intervals(axes, points, PALETTE[place % len(PALETTE)], name)
        for name, rate in (references or {}).get(title, {}).items():
            axes.axhline(rate, color=FAINT, linestyle="--", linewidth=1.2, label=name)
        axes.set_xticks(numbers, _labels(numbers))
        axes.set_xlim(0.8 * numbers[0], 1.25 * numbers[-1])
        axes.minorticks_off()
        in_percent(axes, max(0.0, 0.1 * math.floor(10 * low)))
    _shared_legend(figure, grid)
    return figure


def _shared_legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """Add one legend below for all panels."""
    shown: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        shown |= dict(zip(labels, handles, strict=True))
    style = {"loc": "outside lower center", "ncols": len(shown)}
    add_legend(figure, handles=list(shown.values()), labels=list(shown), **style)


def _labels(numbers: Sequence[int]) -> list[str]:
    """Label numbers as 500 or 2K, but none so near to the last label that they would touch."""
    apart = (numbers[-1] / numbers[0]) ** LABELS_APART
    labels, last = [], 0.0
    for number in numbers:
        fits = number >= apart * last
        short = f"{number / 1000:g}K" if number >= 1000 else str(number)
        labels.append(short if fits else "")
        last = number if fits else last
    return labels


def _with_intervals(
    axes: Axes, placed: Sequence[tuple[float, Rate]], colour: str, label: str = ""
) -> None:
    """Draw a line through rates, each at its place, with their intervals."""
    rates = [rate for _, rate in placed]
    axes.errorbar(
        [place for place, _ in placed],
        [rate.rate for rate in rates],
        yerr=[[r.rate - r.low for r in rates], [r.high - r.rate for r in rates]],
        color=colour,
        linewidth=1.8,
        marker="o",
        ms=5,
        capsize=3,
        label=label,
    )


def reliability_diagram(bins: Sequence[tuple[float, Rate]], *, title: str = "") -> Figure:
    """Draw how often something was true against its predicted probability, with intervals.

    Numbers at the points count predictions; on the diagonal predictions are calibrated.

    Args:
        bins: as :func:`ifo_grounding.stats.reliability` returns them.
        title: above the plot.

    >>> from ifo_grounding.stats import reliability
    >>> reliability_diagram(reliability([0.2, 0.8, 0.9], [0, 1, 1])).axes[0].get_xlabel()
    'predicted'
    """
    if not bins:
        raise UserError("a reliability diagram needs at least one bin")
    figure, grid = new_figure(4.4, 4.0)
    axes = grid[0, 0]
    dress(axes, title, "predicted", "true", grid="both")
    axes.plot([0, 1], [0, 1], color=FAINT, linestyle="--", linewidth=1.2)
    _with_intervals(axes, bins, PALETTE[0])
    for place, rate in bins:
        at, aside = (place, rate.rate), (7, -11)
        style: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8, "color": FAINT}
        axes.annotate(f"{rate.count:,}", at, aside, **style)
    in_percent(axes)
    axes.set_xlim(-0.02, 1.1)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    return figure
