"""Animations of episodes, with the instruction below."""

from __future__ import annotations

import io
from collections.abc import Sequence

from PIL import Image

from ifo_grounding import keys
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation.recording import Episode
from ifo_grounding.report.drawing import Captioned, draw_sheet
from ifo_grounding.report.theme import BAD, GOOD, RUNNING


def animation(
    episodes: Sequence[Episode],
    *,
    titles: Sequence[str] | None = None,
    actions: Sequence[str] = keys.ACTIONS,
    columns: int = 4,
    width: int = 200,
) -> bytes:
    """Return episodes side by side as a GIF that repeats.

    The border of an episode turns green when it ends in success and orange when it fails, and a
    word says so; it then waits for the others.

    Args:
        episodes: what to show, such as :func:`~ifo_grounding.evaluation.record_episodes` returns.
        titles: a word above each, such as ``phase 1``.
        actions: names of the actions, by default those of the grid.
        width: about how wide an episode is drawn, in pixels; frames are enlarged without blur.

    Raises:
        UserError: without episodes, or where titles do not match them or actions lack a name.

    >>> import numpy as np
    >>> frames = np.zeros((3, 3, 48, 48), dtype=np.uint8)
    >>> episode = Episode(frames, np.array([1, 5]), "move to the red circle", True, True, 0)
    >>> Image.open(io.BytesIO(animation([episode]))).n_frames
    3
    """
    if not episodes:
        raise UserError("an animation needs at least one episode")
    if titles is not None and len(titles) != len(episodes):
        raise UserError(f"titles must be one per episode, got {len(titles)} of {len(episodes)}")
    count = 1 + max(int(max(e.actions, default=0)) for e in episodes)
    if len(actions) < count:
        raise UserError(f"there are {count} actions and {len(actions)} names: name all of them")
    titled = list(zip(episodes, titles or [""] * len(episodes), strict=True))
    steps = range(max(len(episode.frames) for episode in episodes))
    cells = ([_cell(episode, title, step, actions) for episode, title in titled] for step in steps)
    return gif([draw_sheet(each, columns=columns, width=width) for each in cells], fps=4)


def _cell(episode: Episode, title: str, step: int, actions: Sequence[str]) -> Captioned:
    last = len(episode.frames) - 1
    frame, ended = episode.frames[min(step, last)], step >= last
    if not ended:
        note = f"step {step}" if step == 0 else f"step {step}: {actions[episode.actions[step - 1]]}"
        return Captioned(frame, episode.sentence, title, note, RUNNING)
    ending = "success" if episode.success else "failure"
    note = f"{ending} after {last}" if episode.stopped else f"{ending}, never stopped"
    return Captioned(frame, episode.sentence, title, note, GOOD if episode.success else BAD)


def gif(pictures: Sequence[Image.Image], fps: float) -> bytes:
    """Return pictures of one size as a GIF that repeats, the last one held for 2.5 s."""
    # One palette, from the first and the last picture, keeps colours from flickering.
    both = Image.new("RGB", (pictures[0].width, 2 * pictures[0].height))
    both.paste(pictures[0], (0, 0))
    both.paste(pictures[-1], (0, pictures[0].height))
    palette = both.quantize(128, dither=Image.Dither.NONE)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    durations = [round(1000 / fps)] * (len(frames) - 1) + [2500]
    buffer = io.BytesIO()
    frames[0].save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        disposal=1,
    )
    return buffer.getvalue()
