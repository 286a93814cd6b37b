"""Plots of rates beside each other, and beside what was said of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ifo_grounding.errors import UserError
from ifo_grounding.report.plots import _dress, _figure, _legend, _percent
from ifo_grounding.report.theme import LIGHT, PALETTE
from ifo_grounding.stats import Rate


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
    curves: Mapping[str, Mapping[int, Rate]],
    *,
    x: str = "demonstrations",
    references: Mapping[str, float] | None = None,
    title: str = "",
) -> Figure:
    """Draw rates against a number that grows by factors, with intervals.

    Args:
        curves: name of the curve -> {number: rate}.
        x: what the number counts.
        references: name -> rate, drawn as a dashed line across.
        title: above the plot.

    >>> from ifo_grounding.stats import wilson
    >>> curves = {"phase 1": {500: wilson(60, 100), 2000: wilson(80, 100)}}
    >>> rates_by_number(curves, references={"paper": 0.766}).axes[0].get_xscale()
    'log'
    """
    if not any(curves.values()):
        raise UserError("rates_by_number needs at least one curve with one rate")
    figure, grid = _figure(6.4, 3.8)
    axes = grid[0, 0]
    _dress(axes, title, x)
    axes.set_xscale("log")
    for place, (name, curve) in enumerate(curves.items()):
        colour = PALETTE[place % len(PALETTE)]
        numbers = sorted(curve)
        rates = [curve[number] for number in numbers]
        axes.fill_between(
            numbers,
            [rate.low for rate in rates],
            [rate.high for rate in rates],
            color=colour,
            alpha=0.18,
            linewidth=0,
        )
        axes.plot(numbers, [r.rate for r in rates], color=colour, marker="o", ms=5, label=name)
    for name, rate in (references or {}).items():
        axes.axhline(rate, color=LIGHT["faint"], linestyle="--", linewidth=1.2)
        axes.annotate(
            name,
            (1.0, rate),
            (-4, 3),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=9,
            color=LIGHT["faint"],
            ha="right",
        )
    numbers = sorted({number for curve in curves.values() for number in curve})
    axes.set_xticks(numbers, [f"{number:,}" for number in numbers])
    axes.minorticks_off()
    _percent(axes)
    _legend(axes, loc="lower right")
    return figure


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
    said = [place for place, _ in bins]
    true = [rate.rate for _, rate in bins]
    below = [rate.rate - rate.low for _, rate in bins]
    above = [rate.high - rate.rate for _, rate in bins]
    axes.errorbar(
        said,
        true,
        yerr=[below, above],
        color=PALETTE[0],
        linewidth=1.8,
        marker="o",
        ms=5,
        capsize=3,
    )
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
