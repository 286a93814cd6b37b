"""Demonstrations from and to pictures and videos: a list of instructions, and frames of each."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence, UnidentifiedImageError
from torch import Tensor
from tqdm import tqdm

from ifo_grounding.data._reading import COLOURS, naming, stack_pictures
from ifo_grounding.data._video import read_video, write_video
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.files import atomic_write
from ifo_grounding.tasks.vocabulary import Vocabulary

LIST = "episodes.jsonl"
FORMATS = ("png", "gif", "mp4")
VIDEOS = {".mp4", ".mov", ".mkv", ".avi", ".webm"}
FILES = {".png", ".jpg", ".jpeg", ".bmp", ".webp"}
MILLISECONDS = 250


@dataclass(frozen=True)
class Listed:
    """A line of the list."""

    name: str
    instruction: str
    path: Path
    """Folder of pictures, in the order of their names, one animated picture, or a video."""


def load_pictures(
    folder: str | Path,
    *,
    vocabulary: Vocabulary | None = None,
    tile_size: int | None = None,
    close: bool = True,
    progress: bool = False,
) -> Demonstrations:
    """Read demonstrations that were recorded as pictures.

    The folder holds ``episodes.jsonl`` with one line per episode, such as
    ``{"episode": "0001", "instruction": "go to the red ball"}``, and for each of them a folder of
    that name with its frames, in the order of their names, an animated picture of that name
    (``0001.gif``) or a video (``0001.mp4``, with the extra ``video``). A line may name another path
    as ``"frames"``.

    Frames are read one episode after the other: the pixels of all episodes are never in memory
    together. A video is lossy: its frames are those that a player shows, not those that were
    recorded, and a repeated last frame may come back a little different.

    Args:
        folder: where from.
        vocabulary: the words of the instructions; by default those that occur.
        tile_size: of the codec; the cheapest one by default.
        close: whether to repeat the last frame of episodes that do not show their stop.
        progress: whether to show a bar.

    Raises:
        UserError: naming the episode, where a line, a frame or an instruction is not as it has to
            be.
    """
    shown = (
        (one.name, stack_pictures(one.name, _pictures(one)), one.instruction)
        for one in tqdm(read_list(Path(folder)), desc="read", disable=not progress)
    )
    return Demonstrations.from_episodes(
        shown, vocabulary=vocabulary, tile_size=tile_size, close=close
    )


def read_list(folder: Path) -> list[Listed]:
    """Read the list of a folder's episodes.

    Raises:
        UserError: where it is missing or empty, or a line of it is not as it has to be.
    """
    path = folder / LIST
    if not path.exists():
        raise UserError(
            f"{path} does not exist: write one line per episode, such as "
            '{"episode": "0001", "instruction": "go to the red ball"}'
        )
    episodes: list[Listed] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if not line.strip():
            continue
        try:
            entry = json.loads(line)
            name, instruction = str(entry["episode"]), str(entry["instruction"]).strip()
        except (json.JSONDecodeError, KeyError, TypeError):
            raise UserError(
                f"{path}, line {number}: a line is a JSON object with 'episode' and 'instruction'"
            ) from None
        if not instruction:
            raise UserError(f"episode {name!r} has no instruction ({path}, line {number})")
        episodes.append(Listed(name, instruction, _where(folder, name, entry.get("frames"))))
    if not episodes:
        raise UserError(f"{path} lists no episode")
    name, times = Counter(episode.name for episode in episodes).most_common(1)[0]
    if times > 1:
        raise UserError(f"{path} lists episode {name!r} {times} times")
    return episodes


def _where(folder: Path, name: str, given: object) -> Path:
    if given is not None:
        path = folder / str(given)
    else:
        paths = [folder / f"{name}{suffix}" for suffix in ("", ".gif", *sorted(VIDEOS))]
        path = next((path for path in paths if path.exists()), paths[0])
    if not path.exists():
        raise UserError(f"episode {name!r} has no frames: {path} does not exist")
    return path


def _pictures(episode: Listed) -> Iterator[tuple[str, Image.Image]]:
    """Yield name and picture of each frame."""
    if episode.path.is_dir():
        paths = sorted(p for p in episode.path.iterdir() if p.suffix.lower() in FILES)
        if not paths:
            raise UserError(
                f"episode {episode.name!r} has no frames: {episode.path} holds none of "
                + ", ".join(sorted(FILES))
            )
    elif episode.path.suffix.lower() in VIDEOS:
        with naming(episode.name):
            for number, frame in enumerate(read_video(episode.path)):
                yield f"{episode.path.name}, frame {number}", frame
        return
    else:
        paths = [episode.path]
    for path in paths:
        try:
            with Image.open(path) as opened:
                for number, frame in enumerate(ImageSequence.Iterator(opened)):
                    name = path.name if episode.path.is_dir() else f"{path.name}, frame {number}"
                    yield name, frame
        except (UnidentifiedImageError, OSError, SyntaxError) as error:
            raise UserError(f"episode {episode.name!r}: {path} cannot be read ({error})") from None


def save_pictures(
    demos: Demonstrations, folder: str | Path, *, kind: str = "png", scale: int = 1
) -> None:
    """Write demonstrations as pictures, to look at or for other tools.

    Args:
        demos: with a vocabulary.
        folder: where to; it appears when everything is written, and :func:`load_pictures` reads it.
        kind: ``png``, a folder of frames per episode; ``gif``, an animation of each; or ``mp4``, a
            video of each, with the extra ``video``. A GIF holds 256 colours a frame, and a video is
            lossy: to keep frames as they are, take ``png``.
        scale: by which every pixel is enlarged.

    Raises:
        UserError: where there is no vocabulary, the kind is unknown, or images do not fit it.
    """
    check_choice("kind", kind, FORMATS)
    if scale < 1:
        raise UserError(f"scale must be at least 1, got {scale}")
    sentences = demos.sentences()
    check_colours(demos)
    digits = len(str(len(demos) - 1))
    with atomic_write(folder) as temporary:
        temporary.mkdir()
        lines = []
        for number, sentence in enumerate(sentences):
            name = f"{number:0{digits}d}"
            lines.append(json.dumps({"episode": name, "instruction": sentence}))
            frames = rgb(demos[number]["pixels"]).repeat(scale, 1).repeat(scale, 2)
            if kind == "mp4":
                write_video(temporary / f"{name}.mp4", frames, fps=1000 / MILLISECONDS)
                continue
            pictures = [Image.fromarray(frame) for frame in frames]
            if kind == "gif":
                pictures[0].save(
                    temporary / f"{name}.gif",
                    save_all=True,
                    append_images=pictures[1:],
                    duration=MILLISECONDS,
                    loop=0,
                )
                continue
            (temporary / name).mkdir()
            for step, picture in enumerate(pictures):
                picture.save(temporary / name / f"{step:04d}.png")
        (temporary / LIST).write_text("\n".join(lines) + "\n", encoding="utf-8")


def check_colours(demos: Demonstrations) -> None:
    """Refuse frames that are no pictures."""
    if demos.image_shape[0] not in COLOURS:
        raise UserError(f"pictures have 1 or 3 colours, these frames have {demos.image_shape[0]}")


def rgb(pixels: Tensor) -> np.ndarray:
    """Return frames [*B, C, H, W] of one or three colours as pictures, uint8 [*B, H, W, 3]."""
    return pixels.expand(*pixels.shape[:-3], 3, -1, -1).movedim(-3, -1).contiguous().numpy()
