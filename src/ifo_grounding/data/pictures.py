"""Demonstrations from and to pictures and videos: a list of instructions, and frames of each."""

from __future__ import annotations

import functools
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence
from torch import Tensor
from tqdm import tqdm

from ifo_grounding.data._episodes import refuse_empty
from ifo_grounding.data._reading import BROKEN, COLOURS, LAST, MODES, naming, stack_pictures
from ifo_grounding.data._video import read_video, write_video
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.files import atomic_write
from ifo_grounding.tasks.vocabulary import Vocabulary

LIST = "episodes.jsonl"
FORMATS = ("png", "gif", "mp4")
VIDEOS = {".mp4", ".mov", ".mkv", ".avi", ".webm"}
ANIMATED = (".gif", *sorted(VIDEOS))
FILES = {
    ".png",
    ".jpg",
    ".jpeg",
    ".jpe",
    ".jfif",
    ".bmp",
    ".webp",
    ".tif",
    ".tiff",
    ".ppm",
    ".pgm",
    ".tga",
}
MILLISECONDS = 250
COMMENT = b"ifo-grounding: a frame lasts %d ms"
"""Kept in a GIF, where Pillow writes equal frames in a row as one that lasts longer."""
EXTENSION, PICTURE, TRAILER = 0x21, 0x2C, 0x3B
"""First bytes of the blocks of a GIF."""


@dataclass(frozen=True)
class Listed:
    """A line of the list."""

    name: str
    instruction: str
    path: Path
    """Folder of pictures, one animated picture, or a video."""


def load_pictures(
    folder: str | Path,
    *,
    vocabulary: Vocabulary | None = None,
    tile_size: int | None = None,
    channels: int = 3,
    close: bool = True,
    progress: bool = False,
) -> Demonstrations:
    """Read demonstrations that were recorded as pictures.

    The folder holds ``episodes.jsonl`` with one line per episode, such as
    ``{"episode": "0001", "instruction": "go to the red ball"}``, and for each of them a folder of
    that name with its frames, in the order of their names (``2.png`` before ``10.png``), an
    animated picture of that name (``0001.gif``) or a video (``0001.mp4``, with the extra
    ``video``). A line may name another path as ``"frames"``.

    Frames that are numbered have to be numbered evenly: a missing one is an error. A GIF of
    :func:`save_pictures` comes back with every frame. Of other GIFs, each picture is one frame
    however long it lasts.

    Frames are read one episode after the other: the pixels of all episodes are never in memory
    together. A video is lossy: its frames are those that a player shows, not those that were
    recorded, and a repeated last frame may come back a little different.

    Args:
        folder: where from.
        vocabulary: the words of the instructions; by default those that occur.
        tile_size: of the codec; the cheapest one by default.
        channels: 1 reads pictures as grey, 3 in colours, 4 with alpha.
        close: whether to repeat the last frame of episodes that do not show their stop.
        progress: whether to show a bar.

    Raises:
        UserError: naming the episode, where a line, a frame or an instruction is not as it has to
            be.
    """
    check_choice("channels", channels, MODES)
    shown = (
        (one.name, stack_pictures(one.name, _pictures(one), channels), one.instruction)
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
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise UserError(f"{path} cannot be read ({error}): save it as UTF-8") from None
    animations = functools.cache(_animations)
    episodes: list[Listed] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            entry = json.loads(line)
            name, instruction = str(entry["episode"]), entry["instruction"]
        except (json.JSONDecodeError, KeyError, TypeError):
            raise UserError(
                f"{path}, line {number}: a line is a JSON object with 'episode' and 'instruction'"
            ) from None
        if not isinstance(instruction, str) or not instruction.strip():
            raise UserError(
                f"episode {name!r} has no instruction ({path}, line {number}): give a sentence, "
                f"not {json.dumps(instruction)}"
            )
        where = _where(folder, name, entry.get("frames"), animations)
        episodes.append(Listed(name, instruction.strip(), where))
    if not episodes:
        raise UserError(f"{path} lists no episode")
    name, times = Counter(episode.name for episode in episodes).most_common(1)[0]
    if times > 1:
        raise UserError(f"{path} lists episode {name!r} {times} times")
    return episodes


def _where(
    folder: Path, name: str, given: object, animations: Callable[[Path], dict[str, Path]]
) -> Path:
    path = folder / (name if given is None else str(given))
    if given is None and not path.exists():
        beside = animations(path.parent)
        names = (f"{path.name}{suffix}" for suffix in ANIMATED)
        path = next((beside[name] for name in names if name in beside), path)
    if not path.exists():
        raise UserError(f"episode {name!r} has no frames: {path} does not exist")
    return path


def _animations(folder: Path) -> dict[str, Path]:
    """Return the animated pictures and videos of a folder by name, with suffixes in lower case."""
    paths = sorted(folder.iterdir()) if folder.is_dir() else ()
    named = {f"{path.stem}{path.suffix.lower()}": path for path in paths}
    return {name: path for name, path in named.items() if name.endswith(ANIMATED)}


def _pictures(episode: Listed) -> Iterator[tuple[str, Image.Image]]:
    """Yield name and picture of each frame."""
    if episode.path.is_dir():
        found = (path for path in episode.path.iterdir() if path.suffix.lower() in FILES)
        paths = sorted(found, key=_natural)
        if not paths:
            raise UserError(
                f"episode {episode.name!r} has no frames: {episode.path} holds none of "
                + ", ".join(sorted(FILES))
            )
        _check_numbers(episode.name, paths)
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
                if episode.path.is_dir():
                    _check_single(episode.name, path, opened)
                    yield path.name, opened
                    continue
                lasts = None
                if opened.format == "GIF":
                    _check_gif(path.read_bytes())
                    lasts = _lasts(opened)
                for number, frame in enumerate(ImageSequence.Iterator(opened)):
                    name = f"{path.name}, frame {number}"
                    times = round(frame.info.get("duration", 0) / lasts) if lasts else 1
                    for _ in range(max(1, times)):
                        yield name, frame
        except BROKEN as error:
            raise UserError(f"episode {episode.name!r}: {path} cannot be read ({error})") from None


def _check_single(name: str, path: Path, picture: Image.Image) -> None:
    """Refuse an animation where a frame should be. A photo may hold others, such as a preview."""
    count = getattr(picture, "n_frames", 1)
    if count > 1 and picture.format != "MPO":
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


def _check_gif(content: bytes) -> None:
    """Refuse a GIF that is cut short: Pillow takes what there is where a block has ended.

    Raises:
        OSError: where its blocks do not lead to its trailer.
    """
    try:
        at = 13 + _palette_bytes(content[10])
        while content[at] != TRAILER:
            if content[at] == PICTURE:
                at += 11 + _palette_bytes(content[at + 9])
            elif content[at] == EXTENSION:
                at += 2
            else:  # bytes between blocks mean nothing
                at += 1
                continue
            while content[at]:
                at += 1 + content[at]
            at += 1
    except IndexError:
        raise OSError("it is cut short") from None


def _palette_bytes(flags: int) -> int:
    return 3 << (flags & 7) + 1 if flags & 0x80 else 0


def _lasts(gif: Image.Image) -> int | None:
    """Return the milliseconds that a frame of a GIF lasts, where it says so."""
    said = re.fullmatch(COMMENT.replace(b"%d", b"([1-9][0-9]*)"), gif.info.get("comment", b""))
    return int(said[1]) if said else None


def save_pictures(
    demos: Demonstrations, folder: str | Path, *, kind: str = "png", scale: int = 1
) -> None:
    """Write demonstrations as pictures, to look at or for other tools.

    Args:
        demos: with a vocabulary.
        folder: where to, a new or an empty one; it appears when everything is written, and
            :func:`load_pictures` reads it.
        kind: ``png``, a folder of frames per episode; ``gif``, an animation of each; or ``mp4``, a
            video of each, with the extra ``video``. A GIF holds 256 colours a frame, and a video is
            lossy: to keep frames as they are, take ``png``.
        scale: by which every pixel is enlarged.

    Raises:
        UserError: where the folder holds something, there is no demonstration or no vocabulary, the
            kind is unknown, or images do not fit it.
    """
    check_choice("kind", kind, FORMATS)
    if scale < 1:
        raise UserError(f"scale must be at least 1, got {scale}")
    refuse_empty(len(demos))
    folder = Path(folder)
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise UserError(
            f"{folder} exists and is no empty folder: name another one, or remove it first"
        )
    sentences = demos.sentences()
    check_colours(demos, LAST if kind == "png" else COLOURS)
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
                _save_gif(temporary / f"{name}.gif", pictures)
                continue
            (temporary / name).mkdir()
            for step, picture in enumerate(pictures):
                picture.save(temporary / name / f"{step:04d}.png")
        (temporary / LIST).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _save_gif(path: Path, pictures: list[Image.Image]) -> None:
    try:
        pictures[0].save(
            path,
            save_all=True,
            append_images=pictures[1:],
            duration=MILLISECONDS,
            comment=COMMENT % MILLISECONDS,
            loop=0,
        )
    except OverflowError:
        raise UserError(
            f"episode {path.stem!r} stays the same for longer than a GIF can say: save it with "
            "kind='png'"
        ) from None


def check_colours(demos: Demonstrations, allowed: tuple[int, ...] = COLOURS) -> None:
    """Refuse frames that are no pictures."""
    if demos.image_shape[0] not in allowed:
        *others, last = allowed
        raise UserError(
            f"pictures have {', '.join(map(str, others))} or {last} colours, these frames have "
            f"{demos.image_shape[0]}"
        )


def rgb(pixels: Tensor) -> np.ndarray:
    """Return frames [*B, C, H, W] as pictures, uint8 [*B, H, W, 3], or 4 where they have alpha."""
    colours = max(3, pixels.shape[-3])
    return pixels.expand(*pixels.shape[:-3], colours, -1, -1).movedim(-3, -1).contiguous().numpy()
