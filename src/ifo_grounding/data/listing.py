"""The list of a folder of pictures: which episodes it holds, and where their frames lie."""

from __future__ import annotations

import functools
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ifo_grounding.data._images import SUFFIXES
from ifo_grounding.errors import UserError

LIST = "episodes.jsonl"
VIDEOS = (".avi", ".mkv", ".mov", ".mp4", ".webm")
ANIMATED = (".gif", *VIDEOS)


@dataclass(frozen=True)
class Listed:
    """A line of the list."""

    name: str
    instruction: Any
    """A sentence, if the list is as it has to be."""
    path: Path
    """Folder of pictures, one animated picture, or a video."""
    cut: bool
    """Whether the recording was cut before the demonstrator stopped."""


def read_list(folder: Path) -> list[Listed]:
    """Read the list of a folder's episodes.

    Raises:
        UserError: where it is missing or empty, or a line of it is not as it has to be.
    """
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
    files = functools.cache(_files)
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
        where = _where(folder, name, entry.get("frames"), files)
        cut = bool(entry.get("truncated", False))
        episodes.append(Listed(name, instruction, where, cut))
    if not episodes:
        raise UserError(f"{path} lists no episode")
    name, times = Counter(episode.name for episode in episodes).most_common(1)[0]
    if times > 1:
        raise UserError(f"{path} lists episode {name!r} {times} times")
    return episodes


def _where(
    folder: Path, name: str, given: object, files: Callable[[Path], Mapping[str, list[Path]]]
) -> Path:
    path = folder / (name if given is None else str(given))
    if given is None and not path.exists():
        beside = files(path.parent).get(path.name, ())
        path = min(beside, key=lambda each: each.suffix.lower() not in ANIMATED, default=path)
    if not path.exists():
        raise UserError(f"episode {name!r} has no frames: {path} does not exist")
    if not path.is_dir() and not path.is_file():
        raise UserError(f"episode {name!r}: {path} is neither a folder nor a regular file")
    suffix = path.suffix.lower()
    if path.is_file() and suffix not in ANIMATED and suffix not in SUFFIXES:
        raise UserError(
            f"episode {name!r}: {path} is of a kind that is not read: give a folder of pictures, "
            f"or one of {', '.join(ANIMATED)}"
        )
    return path


def _files(folder: Path) -> Mapping[str, list[Path]]:
    """Return the files of a folder by their names without suffix."""
    files = defaultdict(list)
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        files[path.stem].append(path)
    return files
