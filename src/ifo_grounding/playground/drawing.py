"""Boards, bars and filmstrips as HTML; whatever a person typed is escaped."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape

import numpy as np
from PIL import Image

from ifo_grounding.playground.agent import Played
from ifo_grounding.report.drawing import coloured
from ifo_grounding.report.tracing import sharpest
from ifo_grounding.texts import one_line
from ifo_grounding.world import render

TILE = 32
"""Pixels along one side of a cell, where a grid is drawn for people."""
STYLE = """
.boards { display: flex; flex-wrap: wrap; gap: 1.5rem; }
.boards figure { flex: 1 1 17rem; max-width: 26rem; margin: 0; min-width: 0; }
.boards figcaption { font-weight: 600; margin-bottom: .3rem; }
.board { position: relative; line-height: 0; }
.board img, .strip img { width: 100%; image-rendering: pixelated; border-radius: 4px; }
.board svg { position: absolute; inset: 0; width: 100%; height: 100%; }
.board [data-cell]:hover { fill: rgb(255 255 255 / .25); cursor: crosshair; }
.bar { display: grid; grid-template-columns: 6.5rem 1fr 3rem; gap: .5rem; align-items: center; }
.bar i { display: block; height: .7rem; background: #94a3b8; border-radius: 2px; min-width: 1px; }
.bar.chosen { font-weight: 600; } .bar.chosen i { background: #2563eb; }
.good { color: #15803d; } .bad, .wrong { color: #c2410c; }
.dark .good { color: #4ade80; } .dark .bad, .dark .wrong { color: #fb923c; }
.strip { display: flex; flex-wrap: wrap; gap: .5rem; }
.strip div { width: 5.5rem; font-size: .8rem; text-align: center; }
.rows { width: 100%; border-collapse: collapse; }
.rows td, .rows th { text-align: left; padding: .25rem .5rem; }
.rows tr[data-row]:hover, .rows tr.chosen { background: rgb(37 99 235 / .15); cursor: pointer; }
.pad { display: flex; flex-wrap: wrap; gap: .4rem; margin-top: .5rem; }
.pad button { padding: .4rem .8rem; border: 1px solid #94a3b8; border-radius: 6px; }
"""
EVENTS = """
element.tabIndex = 0;
const tell = event => {
  const on = event.target.closest('[data-cell],[data-act],[data-row]');
  if (on) trigger('click', {...on.dataset});
};
// A click would be lost where the picture is drawn anew between press and release.
element.addEventListener('pointerup', tell);
element.addEventListener('click', event => { if (event.detail === 0) tell(event); });
element.addEventListener('keydown', event => {
  const on = element.querySelector(`[data-key="${event.key}"]`);
  if (on) { event.preventDefault(); trigger('click', {...on.dataset}); }
});
"""
"""Tells the page which cell, action or row was clicked, or whose key was pressed."""
WORDS = {"U": "up", "R": "right", "D": "down", "L": "left", "P": "pick or place", "S": "stop"}
KEYS = {
    **{"up": "ArrowUp", "right": "ArrowRight", "down": "ArrowDown", "left": "ArrowLeft"},
    **{"forward": "ArrowUp", "pick or place": " ", "pickup": " ", "stop": "Enter", "done": "Enter"},
}
"""Keys of a keyboard, by what an action is called."""
SIGNS = {" ": "space", "ArrowUp": "↑", "ArrowRight": "→", "ArrowDown": "↓", "ArrowLeft": "←"}


def action_words(actions: Sequence[str]) -> list[str]:
    """Return what actions are called: the grid's letters in words, others as they are.

    >>> action_words(["U", "forward"])
    ['up', 'forward']
    """
    return [WORDS.get(name, one_line(name)) for name in actions]


def picture(frame: np.ndarray) -> str:
    """Return a frame, uint8 [H, W, C], as the source of an image."""
    buffer = io.BytesIO()
    Image.fromarray(coloured(frame.transpose(2, 0, 1))).save(buffer, format="PNG", compress_level=1)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def boards(
    played: dict[str, Played], at: int, actions: Sequence[str], *, looks: bool, arranges: bool
) -> str:
    """Draw what each policy does at step ``at``, side by side.

    Args:
        played: by what the policies learned from.
        at: number of the step, from 0; a policy that ended before stays at its end.
        actions: names of the actions.
        looks: whether to show where the policy looks.
        arranges: whether a click on a cell is told to the page.
    """
    parts = []
    for name, one in played.items():
        steps = len(one.trace.episode.actions)
        parts.append(_figure(name, one, min(at, steps), action_words(actions), looks, arranges))
    return f'<div class="boards">{"".join(parts)}</div>'


def _figure(
    name: str, one: Played, at: int, actions: Sequence[str], looks: bool, arranges: bool
) -> str:
    trace, steps = one.trace, len(one.trace.episode.actions)
    if one.states:
        frame = render(one.states[at], TILE)[0].permute(1, 2, 0).numpy()
    else:
        frame = trace.episode.frames[at].transpose(1, 2, 0)
    over = _weights(trace.maps[min(at, steps - 1)], trace.maps) if looks else ""
    over += _path(one, at) + (_cells(one) if arranges else "")
    seen = f"{name}, step {at} of {steps}"
    return (
        f"<figure><figcaption>after {escape(name)}</figcaption>"
        f'<div class="board"><img alt="{escape(seen)}" src="{picture(frame)}">{over}</div>'
        f"<p>{_said(one, at)}</p>{_bars(one, min(at, steps - 1), actions)}</figure>"
    )


def _said(one: Played, at: int) -> str:
    """Say how far the episode is, and at its end how it ended."""
    episode, steps = one.trace.episode, len(one.trace.episode.actions)
    said = [f"step {at} of {steps}"]
    if at < steps:
        if one.values:
            said.append(f"value {one.values[at]:.2f}")
        if "goal" in one.trace.rewards:
            said.append(f"goal classifier {one.trace.rewards['goal'][at]:.0%}")
        return " · ".join(said)
    said.append("it stopped" if episode.stopped else "it never stopped")
    if one.fulfilled is not None:
        said.append(f"fulfilled, says the goal classifier: {one.fulfilled:.0%}")
    truth = {True: "fulfilled", False: "not fulfilled", None: "nobody knows"}[one.success]
    colour = {True: "good", False: "bad", None: ""}[one.success]
    return " · ".join([*said, f'in truth: <b class="{colour}">{truth}</b>'])


def _bars(one: Played, at: int, actions: Sequence[str]) -> str:
    chosen = int(one.trace.episode.actions[at])
    rows = []
    for number, probability in enumerate(one.trace.probabilities[at].tolist()):
        rows.append(
            f'<div class="bar{" chosen" if number == chosen else ""}"><span>'
            f"{escape(actions[number])}</span>"
            f'<i style="width: {100 * probability:.0f}%"></i><span>{probability:.0%}</span></div>'
        )
    return "".join(rows)


def _weights(maps: np.ndarray, every: np.ndarray) -> str:
    """Shade the cells that a policy's sharpest maps weigh."""
    shown = maps[sharpest(every, 4)].max(0)
    height, width = shown.shape
    cells = (
        f'<rect x="{x}" y="{y}" width="1" height="1" fill="#f97316" '
        f'fill-opacity="{0.7 * float(np.sqrt(shown[y, x])):.2f}"/>'
        for y in range(height)
        for x in range(width)
        if shown[y, x] > 0.05
    )
    return _layer(width, height, "".join(cells))


def _path(one: Played, at: int) -> str:
    """Draw the arm's path: so far, and fainter what follows."""
    if not one.states:
        return ""
    side = one.states[0].size
    cells = [int(state.arm) for state in one.states]
    points = [f"{cell % side + 0.5},{cell // side + 0.5}" for cell in cells]
    lines = (
        f'<polyline points="{" ".join(part)}" fill="none" stroke="#fff" stroke-width=".09" '
        f'stroke-linejoin="round" stroke-opacity="{shade}"/>'
        for part, shade in ((points[: at + 1], 0.9), (points[at:], 0.3))
        if len(part) > 1
    )
    return _layer(side, side, "".join(lines))


def _cells(one: Played) -> str:
    side = one.states[0].size
    cells = (
        f'<rect x="{n % side}" y="{n // side}" width="1" height="1" fill="transparent" '
        f'data-cell="{n}"/>'
        for n in range(side * side)
    )
    return _layer(side, side, "".join(cells))


def _layer(width: int, height: int, inside: str) -> str:
    return f'<svg viewBox="0 0 {width} {height}" preserveAspectRatio="none">{inside}</svg>'


def strip(frames: Sequence[np.ndarray], notes: Sequence[str] = ()) -> str:
    """Draw frames, uint8 [H, W, C] each, side by side, with a note below each."""
    cells = (
        f'<div><img alt="frame {number}" src="{picture(frame)}">'
        f"{escape(notes[number]) if number < len(notes) else ''}</div>"
        for number, frame in enumerate(frames)
    )
    return f'<div class="strip">{"".join(cells)}</div>'


def pad(frame: np.ndarray, steps: int, actions: Sequence[str]) -> str:
    """Draw the scene in which a person shows something, with a button for each action."""
    buttons = []
    for number, name in enumerate(action_words(actions)):
        key = KEYS.get(name, str(number + 1))
        named = SIGNS.get(key, key)
        buttons.append(
            f'<button data-act="{number}" data-key="{escape(key)}" title="key: {escape(named)}">'
            f"{escape(name)} <small>{escape(named)}</small></button>"
        )
    return (
        f'<div class="boards"><figure><div class="board"><img alt="your scene, after {steps} '
        f'steps" src="{picture(frame)}"></div><p>{steps} steps shown</p>'
        f'<div class="pad">{"".join(buttons)}</div></figure></div>'
    )


def table(
    rows: Sequence[tuple[int, Sequence[object]]], head: Sequence[str], chosen: int | None
) -> str:
    """Draw rows that can be clicked, each with the number that is told to the page."""
    lines = (
        f'<tr data-row="{number}" tabindex="0"{" class=chosen" if number == chosen else ""}>'
        + "".join(f"<td>{escape(one_line(value))}</td>" for value in values)
        + "</tr>"
        for number, values in rows
    )
    heads = "".join(f"<th>{escape(name)}</th>" for name in head)
    return f'<table class="rows"><tr>{heads}</tr>{"".join(lines)}</table>'
