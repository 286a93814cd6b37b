"""An episode as an animation that shows what decided each step."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from ifo_grounding import keys
from ifo_grounding.evaluation.tracing import Trace
from ifo_grounding.report.animation import gif
from ifo_grounding.report.plots import _dress, _figure
from ifo_grounding.report.theme import LIGHT, PALETTE

MAPS = 8
"""Maps that are shown: the sharpest ones."""
DPI = 80


def trace_animation(
    trace: Trace,
    *,
    actions: Sequence[str] = keys.ACTIONS,
    fps: float = 1.5,
    hold: float = 3.0,
) -> bytes:
    """Return a GIF of an episode, step by step.

    Each picture has what the policy sees, the instruction, the probability of each action, what
    the judges have said so far, and where the sharpest maps look.

    Args:
        trace: from :func:`~ifo_grounding.evaluation.trace_episode`.
        actions: names of the actions.
        fps: steps per second.
        hold: seconds for which the last step is shown.
    """
    chosen = sharpest(trace.maps, MAPS)
    pictures = [
        _picture(step_figure(trace, step, chosen, actions)) for step in range(len(trace.maps))
    ]
    return gif(pictures, fps, hold)


def sharpest(maps: np.ndarray, count: int) -> np.ndarray:
    """Return which maps lay most weight on one cell, on average over steps, int64 [count].

    >>> maps = np.zeros((1, 3, 1, 2))
    >>> maps[0, :, 0] = [[0.5, 0.5], [0.9, 0.1], [0.2, 0.8]]
    >>> sharpest(maps, 2).tolist()
    [1, 2]
    """
    peak = maps.reshape(*maps.shape[:2], -1).max(-1).mean(0)
    return np.sort(np.argsort(-peak, kind="stable")[:count])


def step_figure(trace: Trace, step: int, maps: np.ndarray, actions: Sequence[str]) -> Figure:
    """Draw one step of an episode: what is seen, likely, judged and attended to."""
    episode = trace.episode
    figure, _ = _figure(7.6, 5.4)
    figure.clear()
    figure.suptitle(episode.sentence, fontsize=12, fontweight="bold", color=LIGHT["ink"])
    rows = figure.add_gridspec(2, 1, height_ratios=(3, 1.15))
    top = rows[0].subgridspec(1, 3 if trace.rewards else 2)
    _seen(figure.add_subplot(top[0]), trace, step, actions)
    _actions(figure.add_subplot(top[1]), trace, step, actions)
    if trace.rewards:
        _rewards(figure.add_subplot(top[2]), trace, step)
    below = rows[1].subgridspec(1, max(len(maps), 1))
    for place, number in enumerate(maps):
        _map(figure.add_subplot(below[place]), trace, step, int(number))
    return figure


def _seen(axes: Axes, trace: Trace, step: int, actions: Sequence[str]) -> None:
    episode, last = trace.episode, len(trace.episode.actions) - 1
    action = actions[episode.actions[step]]
    ending = ""
    if step == last:
        ending = ", success" if episode.success else ", failure"
    _dress(axes, f"Step {step + 1}: {action}{ending}", grid="")
    _image(axes, episode.frames[step])


def _actions(axes: Axes, trace: Trace, step: int, names: Sequence[str]) -> None:
    _dress(axes, "Probability of actions", grid="x")
    chosen = int(trace.episode.actions[step])
    colours = [PALETTE[0] if number == chosen else "#B6BEC7" for number in range(len(names))]
    axes.barh(range(len(names)), trace.probabilities[step], color=colours)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(0, 1)


def _rewards(axes: Axes, trace: Trace, step: int) -> None:
    _dress(axes, "What the judges say", "step", grid="y")
    for (name, values), colour in zip(trace.rewards.items(), PALETTE, strict=False):
        so_far = np.arange(1, step + 2)
        axes.plot(so_far, values[: step + 1], color=colour, marker="o", markersize=3, label=name)
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlim(0.5, len(trace.episode.actions) + 0.5)
    axes.legend(frameon=False, fontsize=9, loc="upper left", labelcolor=LIGHT["ink"])


def _map(axes: Axes, trace: Trace, step: int, number: int) -> None:
    weights = trace.maps[step, number]
    _dress(axes, grid="")
    axes.set_title(f"map {number + 1}", fontsize=8, color=LIGHT["faint"])
    height, width = trace.episode.frames.shape[-2:]
    _image(axes, trace.episode.frames[step], alpha=0.35)
    # The square root: a weight of a tenth can be seen, an even map stays as good as blank.
    shown = np.sqrt(weights)
    axes.imshow(
        shown, cmap="Oranges", vmin=0, vmax=1, alpha=0.8 * shown, extent=(0, width, height, 0)
    )


def _image(axes: Axes, frame: np.ndarray, alpha: float = 1.0) -> None:
    height, width = frame.shape[-2:]
    axes.imshow(frame.transpose(1, 2, 0), alpha=alpha, extent=(0, width, height, 0))
    axes.set_xticks([])
    axes.set_yticks([])


def _picture(figure: Figure) -> Image.Image:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return Image.open(buffer).convert("RGB")
