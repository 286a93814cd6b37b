"""Plots as matplotlib figures: ``figure.savefig`` or :func:`figure_png` writes one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, PercentFormatter
from scipy.ndimage import uniform_filter1d

from ifo_grounding.errors import UserError
from ifo_grounding.report.theme import FAINT, PALETTE, add_legend, dress, in_percent, new_panels
from ifo_grounding.stats import Rate

SHARES = ("accuracy", "auc", "probability", "removed", "sampled", "share", "stopped", "success")
"""Last words of the names of metrics that are shares, and drawn in percent."""


def training_curves(
    history: Sequence[Mapping[str, Any]],
    panels: Sequence[str] | Mapping[str, Mapping[str, str]] | None = None,
) -> Figure:
    """Draw what was logged, one small plot per metric or per group of them.

    Of many values, their running mean over a fiftieth of them is drawn on top.

    Args:
        history: what was logged, as :func:`~ifo_grounding.training.fit` returns it: a row per
            step with ``step`` and metrics. Values that are None or not finite are left out, and
            so are metrics without any.
        panels: which metrics, in which order, or {title: {metric: label}}; all metrics where None.

    Raises:
        UserError: where none of the metrics was logged, or a row has no step.

    >>> figure = training_curves([{"step": step, "loss": 3.0 - step} for step in range(3)])
    >>> figure.axes[0].get_title(loc="left")
    'loss'
    """
    if any("step" not in row for row in history):
        raise UserError("every row of a history has its 'step', and one here has none")
    logged = [name for name in dict.fromkeys(n for row in history for n in row) if name != "step"]
    if not isinstance(panels, Mapping):
        panels = {name: {name: name} for name in (logged if panels is None else panels)}
    points = {
        name: [
            (row["step"], row[name])
            for row in history
            if row.get(name) is not None and math.isfinite(row[name])
        ]
        for names in panels.values()
        for name in names
    }
    shown = {
        title: {name: label for name, label in names.items() if points[name]}
        for title, names in panels.items()
        if any(points[name] for name in names)
    }
    if not shown:
        raise UserError(f"no metric of {list(points)}: logged were {', '.join(logged) or 'none'}")
    figure, grid = new_panels(len(shown), 4.3, 2.5)
    for axes, (title, names) in zip(grid, shown.items(), strict=True):
        _panel(axes, title, {label: points[name] for name, label in names.items()})
        axes.set_xlim(history[0]["step"] - 0.5, history[-1]["step"] + 0.5)
        top = max(value for name in names for _, value in points[name])
        if top > 0.1 and any(name.rpartition("_")[2] in SHARES for name in names):
            low, top = max(0.0, min(axes.get_ylim()[0], 0.9)), max(1.0, top)  # as returns can be
            in_percent(axes, low, top + 0.05 * (top - low))
    return figure


def _panel(axes: Axes, title: str, lines: Mapping[str, list[tuple[float, float]]]) -> None:
    """Draw one panel: the points of each line, by label."""
    dress(axes, title, "step")
    for (label, points), colour in zip(lines.items(), PALETTE, strict=False):
        steps, values = zip(*points, strict=True)
        span = max(1, len(points) // 50)
        if span > 1:
            axes.plot(steps, values, color=colour, alpha=0.3, linewidth=0.8)
        mean = uniform_filter1d(np.asarray(values, np.float64), span, mode="nearest")
        marker = "o" if len(points) <= 30 else ""
        axes.plot(steps, mean, color=colour, label=label, linewidth=1.8, marker=marker, ms=3.5)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
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
    legend: dict[str, Any] = {}
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
        axes.set_xlim(0.8 * numbers[0], 1.25 * numbers[-1])
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.minorticks_off()
        in_percent(axes, max(0.0, 0.1 * math.floor(10 * low)))
        handles, labels = axes.get_legend_handles_labels()
        legend |= dict(zip(labels, handles, strict=True))
    style = {"loc": "outside lower center", "ncols": len(legend)}
    add_legend(figure, handles=list(legend.values()), labels=list(legend), **style)
    return figure


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


def reliability_diagram(bins: Sequence[tuple[float, Rate]]) -> Figure:
    """Draw how often something was true against its predicted probability, with intervals.

    Numbers at the points count predictions; on the diagonal predictions are calibrated.

    Args:
        bins: as :func:`ifo_grounding.stats.reliability` returns them.

    >>> from ifo_grounding.stats import reliability
    >>> reliability_diagram(reliability([0.2, 0.8, 0.9], [0, 1, 1])).axes[0].get_xlabel()
    'predicted'
    """
    figure, (axes,) = new_panels(1, 4.0, 3.8)
    dress(axes, "", "predicted", "true", grid="both")
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
