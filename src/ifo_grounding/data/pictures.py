"""Demonstrations from and to pictures and videos: a list of instructions, and frames of each."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from ifo_grounding.data._episodes import naming
from ifo_grounding.data._images import (
    BROKEN,
    MODES,
    SUFFIXES,
    animation_frames,
    open_image,
    stack_images,
)
from ifo_grounding.data._video import read_video, write_video
from ifo_grounding.data.buffers import refuse_empty
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.listing import LIST, VIDEOS, Listed, read_list
from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.files import atomic_write

KINDS = ("png", "mp4")
COLOURS = (1, 3)
FRAMES_PER_SECOND = 4


def load_pictures(
    folder: str | Path, *, channels: int = 3, progress: bool = False, **options: Any
) -> Demonstrations:
    """Read demonstrations that were recorded as pictures.

    The folder holds ``episodes.jsonl`` with one line per episode, such as
    ``{"episode": "0001", "instruction": "go to the red ball"}``, and for each of them a folder of
    that name with its frames, in the order of their names (``2.png`` before ``10.png``), an
    animated picture of that name (``0001.gif``) or a video (``0001.mp4``, with the extra
    ``video``). A line may name another path as ``"frames"``, and say ``"truncated": true`` of a
    recording that was cut, whose last frame is no stop.

    Frames that are numbered have to be numbered evenly: a missing one is an error. Each picture of
    a GIF is one frame, however long it lasts.

    Frames are read one episode after the other: the pixels of all episodes are never in memory
    together. A video is lossy: its frames are those that a player shows, not those that were
    recorded, and a repeated last frame may come back a little different.

    Args:
        folder: where from.
        channels: 1 reads pictures as grey, 3 in colours, 4 with alpha.
        progress: whether to show a bar.
        options: for :meth:`Demonstrations.from_episodes`: ``vocabulary``, ``length``,
            ``tile_size``, ``close``.

    Raises:
        UserError: naming the episode, where a line, a frame or an instruction is not as it has to
            be.
    """
    check_choice("channels", channels, MODES)
    shown = (
        (one.name, stack_images(one.name, _images(one), channels), one.instruction, one.cut)
        for one in tqdm(read_list(Path(folder)), desc="read", disable=not progress)
    )
    return Demonstrations.from_episodes(shown, **options)


def _images(episode: Listed) -> Iterator[tuple[str, Image.Image]]:
    """Yield name and image of each frame."""
    path = episode.path
    if path.suffix.lower() in VIDEOS and not path.is_dir():
        with naming(episode.name):
            for number, frame in enumerate(read_video(path)):
                yield f"{path.name}, frame {number}", frame
        return
    try:
        if path.is_dir():
            for path in _frame_files(episode):
                with open_image(path) as opened:
                    _check_single(episode.name, path, opened)
                    yield path.name, opened
            return
        for number, frame in animation_frames(path):
            yield f"{path.name}, frame {number}", frame
    except UserError:
        raise
    except BROKEN as error:
        raise UserError(f"episode {episode.name!r}: {path} cannot be read ({error})") from None


def _frame_files(episode: Listed) -> list[Path]:
    """Return the files of a folder that are its frames, in order."""
    found = list(episode.path.iterdir())
    paths = sorted((path for path in found if path.suffix.lower() in SUFFIXES), key=_natural)
    if not paths:
        others = sorted({path.suffix for path in found if path.suffix})
        raise UserError(
            f"episode {episode.name!r} has no frames: {episode.path} holds none of "
            + ", ".join(SUFFIXES)
            + (f", but {', '.join(others)}" if others else "")
        )
    _check_numbers(episode.name, paths)
    return paths


def _check_single(name: str, path: Path, image: Image.Image) -> None:
    """Refuse an animation where a frame should be. A photo may hold others, such as a preview."""
    count = getattr(image, "n_frames", 1)
    if count > 1 and image.format != "MPO":
        raise UserError(
            f"episode {name!r}: {path.name} holds {count} pictures, and each file of a folder is "
            "one frame: save them one by one, or name the file itself as the frames"
        )


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Return what sorts names by the numbers in them: 2 before 10."""
    parts = re.split("([0-9]+)", path.name)
    return [int(part) if at % 2 else part for at, part in enumerate(parts)], path.name


def _check_numbers(name: str, paths: list[Path]) -> None:
    """Refuse frames, in order, that are all numbered but not evenly."""
    found = [re.fullmatch("(.*?)([0-9]+)", path.stem, re.DOTALL) for path in paths]
    numbered = [(match[1], match[2]) for match in found if match]
    if len(numbered) < len(paths) or len({before for before, _ in numbered}) > 1:
        return
    numbers = [int(digits) for _, digits in numbered]
    steps = [later - number for number, later in pairwise(numbers)]
    if 0 in steps:
        at = steps.index(0)
        raise UserError(
            f"episode {name!r}: {paths[at].name} and {paths[at + 1].name} have the same number: "
            "remove one of them"
        )
    usual = min(steps, default=0)
    for at, step in enumerate(steps):
        if step > usual:
            before, digits = numbered[at]
            missing = f"{before}{numbers[at] + usual:0{len(digits)}d}{paths[at].suffix}"
            raise UserError(
                f"episode {name!r}: {missing} is missing between {paths[at].name} and "
                f"{paths[at + 1].name}: restore it, or number the frames evenly"
            )


def save_pictures(
    demos: Demonstrations, folder: str | Path, *, kind: str = "png", scale: int = 1
) -> None:
    """Write demonstrations as pictures, to look at or for other tools.

    Args:
        demos: with a vocabulary.
        folder: where to, a new or an empty one; it appears when everything is written, and
            :func:`load_pictures` reads it.
        kind: ``png``, a folder of frames per episode, without loss; or ``mp4``, a video of each,
            with loss, with the extra ``video``.
        scale: by which every pixel is enlarged.

    Raises:
        UserError: where the folder holds something, there is no demonstration or no vocabulary, the
            kind is unknown, or images do not fit it.
    """
    check_choice("kind", kind, KINDS)
    scale = at_least_one("scale", scale)
    sentences = written_sentences(demos, tuple(MODES) if kind == "png" else COLOURS)
    folder = Path(folder)
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise UserError(
            f"{folder} exists and is no empty folder: name another one, or remove it first"
        )
    digits = len(str(len(demos) - 1))
    with atomic_write(folder) as temporary:
        temporary.mkdir()
        lines = []
        for number, sentence in enumerate(sentences):
            name = f"{number:0{digits}d}"
            lines.append(json.dumps({"episode": name, "instruction": sentence}))
            frames = rgb(demos[number]["pixels"]).repeat(scale, 1).repeat(scale, 2)
            _save_episode(temporary / name, frames, kind)
        (temporary / LIST).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _save_episode(path: Path, frames: np.ndarray, kind: str) -> None:
    if kind == "mp4":
        write_video(path.with_suffix(".mp4"), frames, fps=FRAMES_PER_SECOND)
        return
    path.mkdir()
    for step, frame in enumerate(frames):
        Image.fromarray(frame).save(path / f"{step:04d}.png")


def written_sentences(demos: Demonstrations, colours: tuple[int, ...] = COLOURS) -> list[str]:
    """Return the instructions of demonstrations that can be written as pictures.

    Raises:
        UserError: where there is none, or one has no instruction, or frames are no pictures.
    """
    refuse_empty(len(demos))
    sentences = demos.sentences()
    if "" in sentences:
        raise UserError(f"demonstration {sentences.index('')} has no instruction: leave it out")
    if demos.image_shape[0] not in colours:
        *others, last = colours
        raise UserError(
            f"pictures have {', '.join(map(str, others))} or {last} colours, these frames have "
            f"{demos.image_shape[0]}"
        )
    return sentences


def rgb(pixels: Tensor) -> np.ndarray:
    """Return frames [*B, C, H, W] as pictures, uint8 [*B, H, W, 3], or 4 where they have alpha."""
    colours = max(3, pixels.shape[-3])
    return pixels.expand(*pixels.shape[:-3], colours, -1, -1).movedim(-3, -1).contiguous().numpy()
