"""An episode as an animation that shows what decided each step."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.container import BarContainer
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.text import Text
from PIL import Image

from ifo_grounding import keys
from ifo_grounding.errors import check_names_of_actions
from ifo_grounding.evaluation.tracing import Trace
from ifo_grounding.report.animation import gif
from ifo_grounding.report.drawing import coloured
from ifo_grounding.report.theme import (
    FAINT,
    INK,
    PALETTE,
    RUNNING,
    add_legend,
    dress,
    new_panels,
    without_formulas,
)
from ifo_grounding.texts import one_line


def trace_animation(trace: Trace, *, actions: Sequence[str] = keys.ACTIONS) -> bytes:
    """Return a GIF of the last 30 steps of an episode.

    Each picture has what the policy sees, the instruction, the probability of each action, the
    learned rewards so far, and the cells that the eight sharpest attention maps weigh.

    Args:
        trace: from :func:`~ifo_grounding.evaluation.trace_episode`.

    Raises:
        UserError: where there is not one name for each action.
    """
    check_names_of_actions(actions, trace.probabilities.shape[-1])
    board = _Board(trace, sharpest(trace.maps, 8), [*map(one_line, actions)])
    end = len(trace.maps)
    return gif([board.picture(step) for step in range(max(0, end - 30), end)], fps=1.5)


def sharpest(maps: np.ndarray, count: int) -> np.ndarray:
    """Return which maps lay most weight on one cell, on average over steps, int64 [count].

    >>> maps = np.zeros((1, 3, 1, 2))
    >>> maps[0, :, 0] = [[0.5, 0.5], [0.9, 0.1], [0.2, 0.8]]
    >>> sharpest(maps, 2).tolist()
    [1, 2]
    """
    peak = maps.reshape(*maps.shape[:2], -1).max(-1).mean(0)
    return np.sort(np.argsort(-peak, kind="stable")[:count])


class _Board:
    """A figure that is laid out once; of each step only what changes is drawn."""

    def __init__(self, trace: Trace, maps: np.ndarray, actions: Sequence[str]) -> None:
        self.trace, self.chosen, self.names = trace, maps, actions
        self.figure, _ = new_panels(1, 7.2, 5.2)
        self.figure.clear()
        sentence = textwrap.fill(one_line(trace.episode.sentence), 70)
        self.figure.suptitle(sentence, fontsize=12, fontweight="bold", color=INK)
        rows = self.figure.add_gridspec(2, 1, height_ratios=(3, 1.15))
        top = rows[0].subgridspec(1, 3 if trace.rewards else 2)
        seen = self.figure.add_subplot(top[0])
        dress(seen, "Step", grid="")
        self.frames = [self._frame(seen)]
        self.bars = self._actions(self.figure.add_subplot(top[1]))
        self.lines = self._rewards(self.figure.add_subplot(top[2])) if trace.rewards else []
        below = rows[1].subgridspec(1, max(len(maps), 1))
        self.weights = [
            self._map(self.figure.add_subplot(below[place]), int(number))
            for place, number in enumerate(maps)
        ]
        without_formulas(self.figure)
        (self.title,) = (text for text in seen.findobj(Text) if text.get_text() == "Step")
        self.changing = [*self.frames, *self.weights, *self.bars, *self.lines, self.title]
        for artist in self.changing:
            artist.set_animated(True)
        canvas = self.figure.canvas
        assert isinstance(canvas, FigureCanvasAgg)
        canvas.draw()
        self.canvas, self.still = canvas, canvas.copy_from_bbox(self.figure.bbox)

    def _frame(self, axes: Axes, alpha: float = 1.0) -> AxesImage:
        frame = self.trace.episode.frames[0]
        height, width = frame.shape[-2:]
        axes.set(xticks=[], yticks=[])
        return axes.imshow(coloured(frame), alpha=alpha, extent=(0, width, height, 0))

    def _actions(self, axes: Axes) -> BarContainer:
        dress(axes, "Probability of actions", grid="x")
        bars = axes.barh(range(len(self.names)), self.trace.probabilities[0])
        axes.set_yticks(range(len(self.names)), self.names)
        axes.invert_yaxis()
        axes.set_xlim(0, 1)
        return bars

    def _rewards(self, axes: Axes) -> list[Line2D]:
        dress(axes, "Learned rewards", "step")
        lines = [
            axes.plot([], [], color=colour, marker="o", markersize=3, label=name)[0]
            for name, colour in zip(self.trace.rewards, PALETTE, strict=False)
        ]
        axes.set(ylim=(-0.03, 1.03), xlim=(0.5, len(self.trace.episode.actions) + 0.5))
        add_legend(axes, loc="upper left")
        return lines

    def _map(self, axes: Axes, number: int) -> AxesImage:
        dress(axes, grid="")
        axes.set_title(f"map {number + 1}", fontsize=8, color=FAINT)
        self.frames.append(self._frame(axes, alpha=0.35))
        extent = self.frames[-1].get_extent()
        weights = self.trace.maps[0, number]
        return axes.imshow(weights, cmap="Oranges", vmin=0, vmax=1, extent=extent)

    def picture(self, step: int) -> Image.Image:
        """Draw one step: frame, probabilities of actions, learned rewards and maps."""
        episode = self.trace.episode
        ended = step == len(episode.actions) - 1
        ending = f", {'success' if episode.success else 'failure'}" if ended else ""
        action = int(episode.actions[step])
        self.title.set_text(f"Step {step + 1}: {self.names[action]}{ending}")
        for image in self.frames:
            image.set_data(coloured(episode.frames[step]))
        for number, bar in enumerate(self.bars):
            bar.set_width(self.trace.probabilities[step, number])
            bar.set_color(PALETTE[0] if number == action else RUNNING)
        for line, values in zip(self.lines, self.trace.rewards.values(), strict=True):
            line.set_data(np.arange(1, step + 2), values[: step + 1])
        for image, number in zip(self.weights, self.chosen, strict=True):
            # The square root: a weight of a tenth can be seen, an even map is as good as blank.
            shown = np.sqrt(self.trace.maps[step, number])
            image.set_data(shown)
            image.set_alpha(0.8 * shown)
        self.canvas.restore_region(self.still)
        for artist in self.changing:
            self.figure.draw_artist(artist)
        return Image.fromarray(np.asarray(self.canvas.buffer_rgba())[..., :3])
