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

from ifo_grounding.data._episodes import Episode, naming
from ifo_grounding.data._images import MODES, SUFFIXES, Source, animation_frames, stack_images
from ifo_grounding.data._video import read_video, write_video
from ifo_grounding.data.buffers import check_demonstrations
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.folder import vacant
from ifo_grounding.errors import UserError, at_least_one, check_choice
from ifo_grounding.files import atomic_write
from ifo_grounding.progress import progress_bar

LIST = "episodes.jsonl"
TRUNCATED = "truncated"
"""What says of an episode that its recording was cut."""
VIDEOS = (".avi", ".mkv", ".mov", ".mp4", ".webm")
READ = (".gif", *VIDEOS, *SUFFIXES)
"""Suffixes of files that hold all frames of an episode."""
COLOURS = (1, 3)
FRAMES_PER_SECOND = 4

Listed = tuple[str, Path, Any, bool]
"""Name, frames (a folder of pictures, an animated picture or a video), instruction, and whether
the recording was cut before the demonstrator stopped."""


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
    a GIF is one frame, however long it lasts. Of a lossy video, a repeated last frame may differ.

    Args:
        channels: 1 reads pictures as grey, 3 in colours, 4 with alpha.
        options: for :meth:`Demonstrations.from_episodes`.

    Raises:
        UserError: naming the episode whose line, frame or instruction is not as it has to be.
    """
    check_choice("channels", channels, MODES)

    def episodes() -> Iterator[Episode]:
        listed = progress_bar(read_list(Path(folder)), desc="read", shown=progress)
        for name, path, instruction, cut in listed:
            with naming(name):
                frames = stack_images(_frames(path), channels)
            yield name, frames, instruction, cut

    return Demonstrations.from_episodes(episodes(), **options)


def read_list(folder: Path) -> list[Listed]:
    """Read the list of a folder's episodes; refuse one with a line that is not as it has to be."""
    path = folder / LIST
    if not path.is_file():
        raise UserError(
            f"{path} does not exist: write one line per episode, such as "
            '{"episode": "0001", "instruction": "go to the red ball"}'
        )
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise UserError(f"{path} cannot be read ({error}): save it as UTF-8") from None
    episodes: dict[str, Listed] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            entry = json.loads(line)
            name, instruction = str(entry["episode"]), entry["instruction"]
            where, cut = str(entry.get("frames") or name), entry.get(TRUNCATED, False)
            if not isinstance(cut, bool):
                raise TypeError
        except (ValueError, KeyError, TypeError, RecursionError):
            raise UserError(
                f"{path}, line {number}: a line is a JSON object with 'episode' and 'instruction', "
                f"and {TRUNCATED!r}, where it is there, is true or false"
            ) from None
        if name in episodes:
            raise UserError(f"{path} lists episode {name!r} twice")
        with naming(name):
            try:
                frames = _where(folder / where)
            except OSError as error:  # a name that no file can have
                raise UserError(f"it has no frames ({error.strerror})") from None
        episodes[name] = name, frames, instruction, cut
    if not episodes:
        raise UserError(f"{path} lists no episode")
    return list(episodes.values())


def _where(path: Path) -> Path:
    """Return where the frames of an episode lie: at a path, or in a file of that name."""
    if not path.exists():
        suffixes = (each for suffix in READ for each in (suffix, suffix.upper()))
        files = (path.with_name(path.name + suffix) for suffix in suffixes)
        path = next(filter(Path.exists, files), path)
    if not path.exists():
        raise UserError(f"it has no frames: neither {path} nor a file such as {path}.mp4 exists")
    if path.is_file() and path.suffix.lower() not in READ:
        raise UserError(
            f"{path} is of a kind that is not read: give a folder of pictures, or one of "
            f"{', '.join(READ)}"
        )
    return path


def _frames(path: Path) -> Iterator[tuple[str, Source]]:
    """Yield the frames of an episode, each with its name."""
    if path.is_dir():
        yield from ((file.name, file) for file in _frame_files(path))
        return
    frames = read_video(path) if path.suffix.lower() in VIDEOS else animation_frames(path)
    for number, frame in enumerate(frames):
        yield f"{path.name}, frame {number}", frame


def _frame_files(folder: Path) -> list[Path]:
    """Return the files of a folder that are its frames, in order."""
    found = list(folder.iterdir())
    paths = sorted((path for path in found if path.suffix.lower() in SUFFIXES), key=_natural)
    if not paths:
        others = sorted({path.suffix for path in found if path.suffix})
        raise UserError(
            f"{folder} holds none of {', '.join(SUFFIXES)}"
            + (f", but {', '.join(others)}" if others else "")
        )
    _check_numbers(paths)
    return paths


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Return what sorts names by the numbers in them: 2 before 10."""
    parts = re.split("([0-9]+)", path.name)
    return [int(part) if at % 2 else part for at, part in enumerate(parts)], path.name


def _check_numbers(paths: list[Path]) -> None:
    """Refuse frames, in order, that are all numbered but not evenly."""
    found = [re.fullmatch("(.*?)([0-9]+)", path.stem, re.DOTALL) for path in paths]
    numbered = [(match[1], match[2]) for match in found if match]
    if len(numbered) < len(paths) or len({before for before, _ in numbered}) > 1:
        return
    numbers = [int(digits) for _, digits in numbered]
    steps = [later - number for number, later in pairwise(numbers)]
    usual = min(steps, default=1)
    for at, step in enumerate(steps):
        pair = paths[at].name, paths[at + 1].name
        if not step:
            raise UserError(f"{' and '.join(pair)} have the same number: remove one of them")
        if step > usual > 0:
            before, digits = numbered[at]
            missing = f"{before}{numbers[at] + usual:0{len(digits)}d}{paths[at].suffix}"
            raise UserError(
                f"{missing} is missing between {' and '.join(pair)}: restore it, or number the "
                "frames evenly"
            )


def save_pictures(
    demos: Demonstrations, folder: str | Path, *, kind: str = "png", scale: int = 1
) -> None:
    """Write demonstrations as pictures, to look at or for other tools.

    Args:
        folder: where to, a new or an empty one; it appears when everything is written, and
            :func:`load_pictures` reads it.
        kind: ``png``, a folder of frames per episode, without loss; ``gif``, an animation of each,
            with loss where there are more than 256 colours; or ``mp4``, a video of each, with loss,
            with the extra ``video``.
        scale: by which every pixel is enlarged.

    Raises:
        UserError: where the folder holds something, there is no demonstration or no vocabulary, the
            kind is unknown, or images do not fit it.
    """
    check_choice("kind", kind, ("png", "gif", "mp4"))
    scale = at_least_one("scale", scale)
    sentences = written_sentences(demos, tuple(MODES) if kind == "png" else COLOURS)
    digits = len(str(len(demos) - 1))
    with atomic_write(vacant(folder)) as temporary:
        temporary.mkdir()
        lines = []
        for number, (sentence, cut) in enumerate(zip(sentences, demos.cut.tolist(), strict=True)):
            name = f"{number:0{digits}d}"
            entry = {"episode": name, "instruction": sentence}
            lines.append(json.dumps(entry | {TRUNCATED: True} if cut else entry))
            frames = rgb(demos[number]["pixels"]).repeat(scale, 1).repeat(scale, 2)
            if kind == "mp4":
                write_video(temporary / f"{name}.mp4", frames, FRAMES_PER_SECOND)
                continue
            if kind == "gif":
                first, *others = map(Image.fromarray, frames)
                how: Any = {"duration": 1000 // FRAMES_PER_SECOND, "loop": 0}
                first.save(temporary / f"{name}.gif", save_all=True, append_images=others, **how)
                continue
            (temporary / name).mkdir()
            for step, frame in enumerate(frames):
                Image.fromarray(frame).save(temporary / name / f"{step:04d}.png")
        (temporary / LIST).write_text("\n".join(lines) + "\n", encoding="utf-8")


def written_sentences(demos: Demonstrations, colours: tuple[int, ...] = COLOURS) -> list[str]:
    """Return the instructions; refuse demonstrations that cannot be written as pictures."""
    check_demonstrations(demos)
    sentences = demos.sentences()
    if "" in sentences:
        raise UserError(f"demonstration {sentences.index('')} has no instruction: leave it out")
    check_choice("number of channels", demos.image_shape[0], colours)
    return sentences


def rgb(pixels: Tensor) -> np.ndarray:
    """Return frames [*B, C, H, W] as pictures, uint8 [*B, H, W, 3], or 4 where they have alpha."""
    colours = max(3, pixels.shape[-3])
    return pixels.expand(*pixels.shape[:-3], colours, -1, -1).movedim(-3, -1).contiguous().numpy()
