"""Plots show the numbers that they were given, light and dark."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.colors import to_hex
from PIL import Image

from ifo_grounding.errors import UserError
from ifo_grounding.report import (
    audit_figure,
    compared_rates,
    confusion,
    figure_png,
    phase_bars,
    rates_by_number,
    reliability_diagram,
    save_figure,
    success_over_iterations,
    training_curves,
)
from ifo_grounding.report.drawing import BAD, GOOD, RUNNING
from ifo_grounding.report.theme import DARK, LIGHT, PALETTE
from ifo_grounding.stats import wilson


def pixels(png):
    """Decode a PNG."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def rgb(colour):
    """Channels of a colour."""
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


def test_curves_hold_the_values_and_their_running_mean():
    steps, values = list(range(100)), [float(i % 2) + 1 for i in range(100)]
    figure = training_curves({"loss": (steps, values), "other": ([0], [1.0])}, ["loss"], smooth=21)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["loss"]
    raw, mean = figure.axes[0].lines
    assert list(raw.get_ydata()) == values
    assert np.allclose(mean.get_ydata()[20:80], 1.5, atol=0.03)
    with pytest.raises(UserError, match="logged were loss"):
        training_curves({"loss": (steps, values)}, ["success"])
    with pytest.raises(UserError, match="none"):
        training_curves({})


def test_shares_are_drawn_in_percent_and_losses_are_not():
    figure = training_curves({"success": ([0, 1], [0.2, 0.9]), "loss": ([0, 1], [3.0, 1.0])})
    shares, losses = figure.axes
    assert shares.yaxis.get_major_formatter()(0.5) == "50%"
    assert losses.get_ylim()[1] > 1.02


def test_an_audit_leaves_out_what_is_undefined_and_shows_all_iterations_in_every_panel():
    nan = float("nan")
    history = [{"step": float(step), "entropy": 0.5, "judge_auc": nan} for step in range(1, 9)]
    history[-1] |= {"success": 1.0, "success_sampled": 0.98, "action_auc": nan}
    success, entropy = audit_figure(history).axes
    assert success.get_title(loc="left") == "True success"
    assert success.get_xlim() == entropy.get_xlim() == (0.5, 8.5)
    assert [line.get_ydata() for line in success.lines] == [(1.0,), (0.98,)]
    assert max(tick for tick in success.get_yticks() if tick <= success.get_ylim()[1]) <= 1.0


def test_success_has_its_interval_as_a_band():
    rates = [wilson(50, 100), wilson(80, 100)]
    figure = success_over_iterations([0, 10], rates, before=wilson(40, 100))
    axes = figure.axes[0]
    band = axes.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == pytest.approx(rates[0].low)
    assert band[:, 1].max() == pytest.approx(rates[1].high)
    assert list(axes.lines[0].get_ydata()) == [0.5, 0.8]
    assert axes.lines[1].get_ydata()[0] == 0.4
    with pytest.raises(UserError, match="one per iteration"):
        success_over_iterations([0, 1, 2], rates)


def test_bars_have_heights_intervals_and_hollow_quotes():
    rates = {"paper": 0.766, "phase 1": wilson(90, 100)}
    figure = phase_bars({"move": rates, "pick": {"phase 1": wilson(50, 100)}})
    axes = figure.axes[0]
    assert [bar.get_height() for bar in axes.patches] == [0.766, 0.9, 0.5]
    assert [bar.get_hatch() for bar in axes.patches] == ["///", None, None]
    low, high = axes.collections[0].get_segments()[0][:, 1]
    assert (low, high) == (
        pytest.approx(rates["phase 1"].low),
        pytest.approx(rates["phase 1"].high),
    )
    assert [text.get_text() for text in axes.texts] == ["76.6", "90.0", "50.0"]
    with pytest.raises(UserError, match="at least one"):
        phase_bars({})


def test_confusion_never_rounds_a_mistake_away():
    figure = confusion([[9999, 1], [0, 5]], ["U", "S"])
    axes = figure.axes[0]
    assert [text.get_text() for text in axes.texts] == [">99.9", "<0.1", "0", "100"]
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["U  (10,000)", "S  (5)"]
    assert axes.images[0].get_array()[0, 0] == pytest.approx(0.9999)
    with pytest.raises(UserError, match="3x3"):
        confusion([[1]], ["a", "b", "c"])


FIGURES = {
    "curves": lambda: training_curves({"loss": ([0, 1, 2], [3.0, 2.0, 1.0])}),
    "success": lambda: success_over_iterations(
        [0, 1], {"greedy": [wilson(1, 9), wilson(5, 9)]}, before=wilson(2, 9)
    ),
    "bars": lambda: phase_bars({"move": {"paper": 0.7, "phase 1": wilson(90, 100)}}),
    "confusion": lambda: confusion([[3, 1], [1, 3]], ["U", "S"]),
}


@pytest.mark.parametrize("name", FIGURES)
def test_the_dark_theme_is_dark_legible_and_undone(name):
    figure = FIGURES[name]()
    light, dark = figure_png(figure), figure_png(figure, theme="dark")
    assert figure_png(figure) == light
    assert (pixels(light)[0, 0] == rgb(LIGHT["paper"])).all()
    shown = pixels(dark)
    assert (shown[0, 0] == rgb(DARK["paper"])).all()
    # No letter or line is left in the light theme's ink, and some are in the dark one's.
    ink = (np.abs(shown.astype(int) - rgb(DARK["ink"])).max(-1) < 12).sum()
    assert ink > 100
    texts = [text for axes in figure.axes for text in axes.texts]
    assert all(to_hex(text.get_color()).upper() != DARK["ink"] for text in texts)


def test_saving_is_atomic_and_free_of_global_state(tmp_path):
    import matplotlib.pyplot as plt

    path = save_figure(FIGURES["curves"](), tmp_path / "deep" / "loss.png")
    assert pixels(path.read_bytes()).shape[2] == 3
    assert [file.name for file in path.parent.iterdir()] == ["loss.png"]
    assert plt.get_fignums() == []


MACHADO = {  # Machado, Oliveira and Fernandes 2009, severity 1, for linear RGB
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
}


@pytest.mark.parametrize("kind", MACHADO)
@pytest.mark.parametrize("colours", [PALETTE[:3], (GOOD, BAD, RUNNING)], ids=["series", "verdicts"])
def test_colours_stay_apart_for_colour_blind_readers(kind, colours):
    linear = (np.array([rgb(colour) for colour in colours]) / 255) ** 2.2
    seen = 255 * np.clip(linear @ np.array(MACHADO[kind]).T, 0, 1) ** (1 / 2.2)
    distance = np.linalg.norm(seen[:, None] - seen[None], axis=-1)
    assert distance[np.triu_indices(3, 1)].min() > 40


def test_reliability_diagram_shows_every_bin_with_its_interval_and_count():
    bins = [(0.15, wilson(200, 1000)), (0.85, wilson(40, 50))]
    axes = reliability_diagram(bins).axes[0]
    (points, _, _) = axes.containers[0]
    assert points.get_xydata().tolist() == [[0.15, 0.2], [0.85, 0.8]]
    assert [text.get_text() for text in axes.texts] == ["1,000", "50"]
    with pytest.raises(UserError, match="at least one bin"):
        reliability_diagram([])


def test_labels_of_near_numbers_do_not_touch():
    curve = {n: wilson(90, 100) for n in (200, 500, 1000, 2000, 5000, 8000, 80_000)}
    axes = rates_by_number({"move": {"phase 1": curve}}).axes[0]
    assert list(axes.get_xticks()) == list(curve)
    labels = [label.get_text() for label in axes.get_xticklabels()]
    assert labels == ["200", "500", "1K", "2K", "5K", "", "80K"]


def test_rates_by_number_shows_each_curve_in_its_panel():
    few, many = wilson(60, 100), wilson(80, 100)
    panels = {"move": {"phase 1": {500: few, 2000: many}, "phase 2": {2000: many}}, "pick": {}}
    figure = rates_by_number(panels, references={"pick": {"the paper": 0.13}})
    first, second = figure.axes
    curve, _, (bars,) = first.containers[0]
    assert curve.get_xydata().tolist() == [[500, 0.6], [2000, 0.8]]
    assert bars.get_segments()[0][:, 1].tolist() == pytest.approx([few.low, few.high])
    assert [label.get_text() for label in second.get_xticklabels()] == ["500", "2K"]
    assert second.lines[0].get_ydata() == [0.13, 0.13]
    assert second.get_ylim()[0] < 0.13
    with pytest.raises(UserError, match="at least one curve"):
        rates_by_number({"move": {"phase 1": {}}})


def test_compared_rates_shows_each_interval_in_its_group():
    rates = {"phase 1": wilson(960, 1000), "phase 2": wilson(990, 1000)}
    axes = compared_rates({"move": rates, "pick": {"phase 2": wilson(500, 1000)}}).axes[0]
    intervals = [line.get_xdata().tolist() for line in axes.lines if len(line.get_xdata()) == 2]
    assert intervals[0] == [rates["phase 1"].low, rates["phase 1"].high]
    assert len(intervals) == 3
    shown = {text.get_text() for text in axes.texts}
    assert {"move", "pick", "96.0", "99.0", "50.0"} == shown
    # Both tasks' phase 2 have one colour.
    assert axes.lines[2].get_color() == axes.lines[4].get_color() != axes.lines[0].get_color()
    with pytest.raises(UserError, match="at least one group"):
        compared_rates({})
