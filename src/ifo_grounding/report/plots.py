"""Plots as matplotlib figures, drawn in colours that colour-blind readers can tell apart.

Every function returns a figure; :func:`save_figure` writes it, light or dark. Nothing here touches
matplotlib's global state or needs a display.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import ArrayLike

from ifo_grounding.errors import UserError
from ifo_grounding.files import atomic_write
from ifo_grounding.report.metrics import Series
from ifo_grounding.report.theme import LIGHT, PALETTE, in_theme
from ifo_grounding.stats import Rate


def _figure(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), facecolor=LIGHT["paper"], layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _dress(axes: Axes, title: str = "", x: str = "", y: str = "", grid: str = "y") -> None:
    axes.set_facecolor(LIGHT["paper"])
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=LIGHT["ink"])
    axes.set_xlabel(x, color=LIGHT["faint"])
    axes.set_ylabel(y, color=LIGHT["faint"])
    axes.tick_params(colors=LIGHT["faint"], length=0, labelsize=9)
    for side, spine in axes.spines.items():
        spine.set_visible(side == "bottom" and grid == "y")
        spine.set_color(LIGHT["faint"])
    if grid:
        axes.grid(axis=grid, color=LIGHT["grid"], linewidth=0.8)  # type: ignore[arg-type]
    axes.set_axisbelow(True)


SHARES = ("accuracy", "probability", "removed", "share", "stopped", "success", "sampled")
"""Last words of the names of metrics that are shares, and drawn in percent."""


def _percent(axes: Axes, low: float = 0.0) -> None:
    axes.set_ylim(low, 1.02)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))


def _legend(of: Axes | Figure, **options: Any) -> None:
    of.legend(frameon=False, labelcolor=LIGHT["ink"], fontsize=9, **options)


def smoothed(values: ArrayLike, span: int) -> np.ndarray:
    """Return the mean of each value and its neighbours within half of ``span`` on either side.

    >>> smoothed([1.0, 3.0, 5.0, 10.0], span=3).tolist()
    [2.0, 3.0, 6.0, 7.5]
    """
    series = np.asarray(values, dtype=np.float64)
    total = np.concatenate([[0.0], np.cumsum(series)])
    place = np.arange(len(series))
    start = np.maximum(0, place - span // 2)
    end = np.minimum(len(series), place + span // 2 + 1)
    return np.asarray((total[end] - total[start]) / (end - start))


def training_curves(
    metrics: Mapping[str, Series],
    names: Sequence[str] | None = None,
    *,
    smooth: int | None = None,
    columns: int = 2,
    x: str = "step",
) -> Figure:
    """Draw one small plot per metric: every value faintly, their running mean on top.

    Args:
        metrics: steps and values by name, as :func:`~ifo_grounding.report.read_metrics` returns.
        names: which metrics, in which order; all where None.
        smooth: how many values a running mean covers; a fiftieth of them where None.
        columns: plots side by side.
        x: what the steps count.

    Raises:
        UserError: where a name was not logged.

    >>> figure = training_curves({"loss": ([0, 1, 2], [3.0, 2.0, 1.0])})
    >>> figure.axes[0].get_title(loc="left")
    'loss'
    """
    chosen = list(metrics) if names is None else list(names)
    missing = [name for name in chosen if name not in metrics]
    if missing or not chosen:
        raise UserError(f"no metric {missing or ''}: logged were {', '.join(metrics) or 'none'}")
    columns = min(columns, len(chosen))
    rows = -(-len(chosen) // columns)
    figure, grid = _figure(4.2 * columns + 0.4, 2.5 * rows + 0.2, rows, columns)
    for index, axes in enumerate(grid.flat):
        if index >= len(chosen):
            axes.set_visible(False)
            continue
        steps, values = metrics[chosen[index]]
        span = smooth or max(1, len(values) // 50)
        _dress(axes, chosen[index], x)
        if span > 1:
            axes.plot(steps, values, color=PALETTE[4], alpha=0.45, linewidth=0.8)
        marker = "o" if len(values) <= 30 else ""
        axes.plot(
            steps, smoothed(values, span), color=PALETTE[0], linewidth=1.8, marker=marker, ms=3.5
        )
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
        if chosen[index].rpartition("_")[2] in SHARES and max(values) > 0.1:
            _percent(axes)
    return figure


def success_over_iterations(
    iterations: Sequence[float],
    rates: Sequence[Rate] | Mapping[str, Sequence[Rate]],
    *,
    before: Rate | None = None,
    title: str = "Success during self-examination",
    x: str = "iteration",
) -> Figure:
    """Draw success with its interval over the iterations of phase 2.

    Args:
        iterations: when success was measured.
        rates: what it was; or several such lists by name (greedy and sampled).
        before: success before the first iteration, drawn as a dashed line.
        title: above the plot.
        x: what the iterations count.

    >>> from ifo_grounding.stats import wilson
    >>> figure = success_over_iterations([0, 10], [wilson(50, 100), wilson(80, 100)])
    >>> figure.axes[0].get_xlabel()
    'iteration'
    """
    lines = dict(rates) if isinstance(rates, Mapping) else {"": list(rates)}
    if any(len(line) != len(iterations) for line in lines.values()):
        raise UserError(f"rates must be one per iteration, {len(iterations)} of them")
    figure, grid = _figure(7.0, 3.6)
    axes = grid[0, 0]
    _dress(axes, title, x)
    for (name, line), colour in zip(lines.items(), PALETTE, strict=False):
        low, high = [rate.low for rate in line], [rate.high for rate in line]
        axes.fill_between(iterations, low, high, color=colour, alpha=0.18, linewidth=0)
        centre = [rate.rate for rate in line]
        axes.plot(iterations, centre, color=colour, linewidth=2, marker="o", ms=4, label=name)
    if before is not None:
        label = f"phase 1: {100 * before.rate:.1f}%"
        axes.axhline(before.rate, color=LIGHT["faint"], linestyle="--", linewidth=1.4, label=label)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _percent(axes)
    if before is not None or len(lines) > 1:
        _legend(axes, loc="best")
    return figure


def phase_bars(
    tasks: Mapping[str, Mapping[str, Rate | float]], *, title: str = "Success by task"
) -> Figure:
    """Draw bars side by side per task, such as phase 1 and phase 2, with intervals.

    Args:
        tasks: task -> {name of the bar: rate}; a plain float (a number from a paper, without an
            interval) is drawn as a hollow bar.
        title: above the plot.

    >>> from ifo_grounding.stats import wilson
    >>> figure = phase_bars({"move": {"phase 1": wilson(90, 100), "phase 2": wilson(95, 100)}})
    >>> [text.get_text() for text in figure.axes[0].texts]
    ['90.0', '95.0']
    """
    names = list(dict.fromkeys(name for bars in tasks.values() for name in bars))
    if not names:
        raise UserError("phase_bars needs at least one task with one rate")
    figure, grid = _figure(max(5.0, 1.2 + 0.62 * len(names) * len(tasks) + 0.4 * len(tasks)), 3.6)
    axes = grid[0, 0]
    _dress(axes, title)
    width = 0.8 / len(names)
    colours = dict(zip(names, PALETTE * len(names), strict=False))
    for place, bars in enumerate(tasks.values()):
        for name, rate in bars.items():
            at = place - 0.4 + width * (names.index(name) + 0.5)
            _bar(axes, at, 0.92 * width, rate, colours[name])
    axes.set_xticks(range(len(tasks)), list(tasks))
    axes.tick_params(axis="x", labelsize=10)
    _percent(axes)
    axes.set_ylim(0, 1.12)
    axes.set_yticks(np.arange(0, 1.01, 0.2))
    known = {n: any(isinstance(bars.get(n), Rate) for bars in tasks.values()) for n in names}
    handles = [Patch(label=name, **_fill(colours[name], known[name])) for name in names]
    _legend(axes, handles=handles, ncols=len(names), loc="upper left", bbox_to_anchor=(0, -0.1))
    return figure


def _fill(colour: str, measured: bool) -> dict[str, Any]:
    """Solid where measured, hollow where quoted."""
    hatch = None if measured else "///"
    face = colour if measured else LIGHT["paper"]
    return {"facecolor": face, "edgecolor": colour, "linewidth": 1.5, "hatch": hatch}


def _bar(axes: Axes, at: float, width: float, rate: Rate | float, colour: str) -> None:
    value = rate.rate if isinstance(rate, Rate) else float(rate)
    top = rate.high if isinstance(rate, Rate) else value
    axes.bar(at, value, width, **_fill(colour, isinstance(rate, Rate)))
    if isinstance(rate, Rate):
        spread = [[value - rate.low], [rate.high - value]]
        axes.errorbar(at, value, yerr=spread, color=LIGHT["ink"], capsize=3, linewidth=1.2)
    text = f"{100 * value:.1f}"
    axes.text(at, top + 0.02, text, ha="center", va="bottom", fontsize=9, color=LIGHT["ink"])


def confusion(matrix: ArrayLike, names: Sequence[str], *, title: str = "Labels") -> Figure:
    """Draw a confusion matrix: rows are the truth, columns what was given, in percent of rows.

    Args:
        matrix: counts, integer [N, N].
        names: of the classes, N of them.
        title: above the plot.

    >>> figure = confusion([[9, 1], [0, 4]], ["go", "stop"])
    >>> [text.get_text() for text in figure.axes[0].texts]
    ['90.0', '10.0', '0', '100']
    """
    counts = np.asarray(matrix)
    if counts.shape != (len(names), len(names)):
        raise UserError(f"matrix must be {len(names)}x{len(names)}, got {list(counts.shape)}")
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    size = 1.6 + 0.55 * len(names)
    figure, grid = _figure(size + 0.2, size)
    axes = grid[0, 0]
    _dress(axes, title, "labelled as", "truth", grid="")
    colours = LinearSegmentedColormap.from_list("blues", ["#EAF2F8", PALETTE[0]])
    axes.imshow(share, cmap=colours, vmin=0, vmax=1)
    axes.set_xticks(range(len(names)), names)
    axes.set_yticks(
        range(len(names)), [f"{n}  ({c:,})" for n, c in zip(names, counts.sum(1), strict=True)]
    )
    for row, column in np.ndindex(*counts.shape):
        # Written on the picture, whose colours are the same in the light and the dark theme.
        colour = "#FDFDFD" if share[row, column] > 0.55 else "#10202E"
        text = _share_text(int(counts[row, column]), float(share[row, column]))
        axes.text(column, row, text, ha="center", va="center", fontsize=9, color=colour)
    return figure


def _share_text(count: int, share: float) -> str:
    if count == 0:
        return "0"
    if share == 1.0:
        return "100"
    # A rare mistake must not be rounded away, in either direction.
    return "<0.1" if share < 0.001 else ">99.9" if share > 0.999 else f"{100 * share:.1f}"


def figure_png(figure: Figure, *, theme: str = "light", dpi: int = 150) -> bytes:
    """Return a figure as PNG, ``theme`` ``"light"`` or ``"dark"``."""
    if figure.get_layout_engine() is not None:
        # Settled once: the layout would otherwise move a little with every drawing.
        figure.draw_without_rendering()
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
    buffer = io.BytesIO()
    with in_theme(figure, theme):
        figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def save_figure(figure: Figure, path: str | Path, *, theme: str = "light", dpi: int = 150) -> Path:
    """Write a figure as PNG, atomically.

    >>> import pathlib, tempfile
    >>> figure = training_curves({"loss": ([0, 1], [2.0, 1.0])})
    >>> save_figure(figure, pathlib.Path(tempfile.mkdtemp()) / "loss.png").name
    'loss.png'
    """
    path = Path(path)
    with atomic_write(path) as temporary:
        temporary.write_bytes(figure_png(figure, theme=theme, dpi=dpi))
    return path
