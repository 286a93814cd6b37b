"""Plots of rates beside each other, and beside what was said of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ifo_grounding.errors import UserError
from ifo_grounding.report.plots import _dress, _figure, _legend, _percent
from ifo_grounding.report.theme import LIGHT, PALETTE
from ifo_grounding.stats import Rate

LABELS_APART = 0.1
"""Share of an axis that two of its labels keep between them."""


def compared_rates(groups: Mapping[str, Mapping[str, Rate]], *, title: str = "") -> Figure:
    """Draw rates and their intervals below each other, on an axis that shows small differences.

    Args:
        groups: what was compared on the same scenes -> {name of the policy: rate}.
        title: above the plot.

    >>> from ifo_grounding.stats import wilson
    >>> rates = {"phase 1": wilson(960, 1000), "phase 2": wilson(990, 1000)}
    >>> [label.get_text() for label in compared_rates({"move": rates}).axes[0].get_yticklabels()]
    ['phase 1', 'phase 2']
    """
    names = list(dict.fromkeys(name for rates in groups.values() for name in rates))
    if not names:
        raise UserError("compared_rates needs at least one group with one rate")
    rows = sum(map(len, groups.values())) + len(groups)
    figure, grid = _figure(7.0, 0.8 + 0.3 * rows)
    axes = grid[0, 0]
    _dress(axes, title, grid="x")
    places, labels, place = [], [], 0.0
    low = min(rate.low for rates in groups.values() for rate in rates.values())
    for group, rates in groups.items():
        axes.text(
            low, place, group, fontsize=10, fontweight="bold", color=LIGHT["ink"], va="center"
        )
        for name, rate in rates.items():
            place += 1
            colour = PALETTE[names.index(name) % len(PALETTE)]
            axes.plot([rate.low, rate.high], [place, place], color=colour, linewidth=2.4)
            axes.plot([rate.rate], [place], color=colour, marker="o", ms=6)
            text = f"{100 * rate.rate:.1f}"
            axes.annotate(
                text,
                (rate.high, place),
                (6, 0),
                textcoords="offset points",
                fontsize=9,
                color=LIGHT["faint"],
                va="center",
            )
            places.append(place)
            labels.append(name)
        place += 1.4
    axes.set_yticks(places, labels)
    axes.set_ylim(place - 0.8, -0.8)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    return figure


def rates_by_number(
    panels: Mapping[str, Mapping[str, Mapping[int, Rate]]],
    *,
    x: str = "demonstrations",
    references: Mapping[str, Mapping[str, float]] | None = None,
) -> Figure:
    """Draw rates against a number that grows by factors, with intervals, in panels side by side.

    Args:
        panels: title of the panel -> {name of the curve: {number: rate}}.
        x: what the number counts.
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
    lines = [rate for known in (references or {}).values() for rate in known.values()]
    low = min([*lines, *(rate.low for curve in every for rate in curve.values())])
    figure, grid = _figure(1.6 + 2.8 * len(panels), 3.4, columns=len(panels))
    for axes, (title, curves) in zip(grid[0], panels.items(), strict=True):
        _dress(axes, title, x)
        axes.set_xscale("log")
        for name, curve in curves.items():
            place = names.index(name)
            ordered = sorted(curve.items())
            aside = 1 + 0.03 * place  # so that no interval hides another
            numbered = [(aside * number, rate) for number, rate in ordered]
            _with_intervals(axes, numbered, PALETTE[place % len(PALETTE)], name)
        for name, rate in (references or {}).get(title, {}).items():
            axes.axhline(rate, color=LIGHT["faint"], linestyle="--", linewidth=1.2, label=name)
        axes.set_xticks(numbers, _labels(numbers))
        axes.set_xlim(0.8 * numbers[0], 1.25 * numbers[-1])
        axes.minorticks_off()
        _percent(axes, max(0.0, 0.1 * math.floor(10 * low)))
    shown: dict[str, Any] = {}
    for axes in grid[0]:
        handles, labels = axes.get_legend_handles_labels()
        shown = dict(zip(labels, handles, strict=True)) | shown
    _legend(
        figure,
        handles=list(shown.values()),
        labels=list(shown),
        loc="outside lower center",
        ncols=len(shown),
    )
    return figure


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
    """Draw what came true against what was said, with intervals; the diagonal is calibrated.

    Args:
        bins: as :func:`ifo_grounding.stats.reliability` returns them.
        title: above the plot.

    >>> from ifo_grounding.stats import reliability
    >>> reliability_diagram(reliability([0.2, 0.8, 0.9], [0, 1, 1])).axes[0].get_xlabel()
    'said'
    """
    if not bins:
        raise UserError("a reliability diagram needs at least one bin")
    figure, grid = _figure(4.4, 4.0)
    axes = grid[0, 0]
    _dress(axes, title, "said", "came true", grid="both")
    axes.plot([0, 1], [0, 1], color=LIGHT["faint"], linestyle="--", linewidth=1.2)
    _with_intervals(axes, bins, PALETTE[0])
    for place, rate in bins:
        text = f"{rate.count:,}"
        axes.annotate(
            text,
            (place, rate.rate),
            (7, -11),
            textcoords="offset points",
            fontsize=8,
            color=LIGHT["faint"],
        )
    _percent(axes)
    axes.set_xlim(-0.02, 1.1)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    return figure
