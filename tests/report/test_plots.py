"""Plots show the numbers that they were given."""

import io

import numpy as np
import pytest
from PIL import Image

from ifo_grounding import report
from ifo_grounding.errors import UserError
from ifo_grounding.report.theme import BAD, GOOD, PALETTE, RUNNING
from ifo_grounding.stats import wilson


def pixels(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def rgb(colour):
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


def logged(**metrics):
    """Rows of a history, one per value."""
    names = list(metrics)
    rows = zip(*metrics.values(), strict=True)
    return [{"step": step, **dict(zip(names, row, strict=True))} for step, row in enumerate(rows)]


def test_curves_hold_the_values_and_their_running_mean():
    values = [float(i % 2) + 1 for i in range(100)]
    history = logged(loss=values, other=[None] * 99 + [1.0], lr=[float("nan")] * 100)
    figure = report.training_curves(history, ["loss", "other", "lr"])
    loss, other = figure.axes  # nothing is known of the third
    assert loss.get_title(loc="left") == "loss"
    raw, mean = loss.lines
    assert list(raw.get_ydata()) == values
    assert np.allclose(mean.get_ydata()[20:80], 1.5)
    assert other.lines[0].get_xydata().tolist() == [[99.0, 1.0]]
    with pytest.raises(UserError, match="logged were loss"):
        report.training_curves(history, ["success"])
    with pytest.raises(UserError, match="none"):
        report.training_curves([])


def test_shares_are_drawn_in_percent_and_losses_are_not():
    shares, losses = report.training_curves(logged(success=[0.2, 0.9], loss=[3.0, 1.0])).axes
    assert shares.yaxis.get_major_formatter()(0.5) == "50%"
    assert losses.get_ylim()[1] > 1.02


def test_panels_leave_out_what_is_undefined_and_show_all_steps():
    nan = float("nan")
    history = [{"step": float(step), "entropy": 0.5, "return_auc": nan} for step in range(1, 9)]
    history[-1] |= {"success": 1.0, "success_sampled": 0.98, "action_auc": nan}
    panels = {
        "AUC": {"return_auc": "return", "action_auc": "reward"},
        "True success": {"success": "greedy", "success_sampled": "sampled"},
        "Entropy": {"entropy": "nats"},
    }
    success, entropy = report.training_curves(history, panels).axes
    assert success.get_title(loc="left") == "True success"
    assert success.get_xlim() == entropy.get_xlim() == (0.5, 8.5)
    assert [line.get_ydata().tolist() for line in success.lines] == [[1.0], [0.98]]
    assert max(tick for tick in success.get_yticks() if tick <= success.get_ylim()[1]) <= 1.0


@pytest.mark.parametrize("text", ["$x", "a $ b $ c", r"$\frac$"])
def test_a_dollar_sign_is_no_formula(text):
    figure = report.training_curves(logged(**{text: [1.0, 2.0]}))
    assert pixels(report.figure_png(figure)).shape[2] == 3
    figure = report.rates_by_number({text: {text: {1: wilson(1, 2)}}})
    assert pixels(report.figure_png(figure)).shape[2] == 3


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
    axes = report.reliability_diagram(bins).axes[0]
    (points, _, _) = axes.containers[0]
    assert points.get_xydata().tolist() == [[0.15, 0.2], [0.85, 0.8]]
    assert [text.get_text() for text in axes.texts] == ["1,000", "50"]


def test_rates_by_number_shows_each_curve_in_its_panel():
    few, many = wilson(60, 100), wilson(80, 100)
    panels = {"move": {"phase 1": {500: few, 2000: many}, "phase 2": {2000: many}}, "pick": {}}
    figure = report.rates_by_number(panels, references={"pick": {"the paper": 0.13}})
    first, second = figure.axes
    curve, _, (bars,) = first.containers[0]
    assert curve.get_xydata().tolist() == [[500, 0.6], [2000, 0.8]]
    assert bars.get_segments()[0][:, 1].tolist() == pytest.approx([few.low, few.high])
    assert "1k" in [label.get_text() for label in second.get_xticklabels()]
    assert second.lines[0].get_ydata() == [0.13, 0.13]
    assert second.get_ylim()[0] < 0.13
    with pytest.raises(UserError, match="at least one curve"):
        report.rates_by_number({"move": {"phase 1": {}}})
