"""The list of a folder of pictures: which episodes it holds, and where their frames lie."""

from __future__ import annotations

import functools
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ifo_grounding.errors import UserError

LIST = "episodes.jsonl"
VIDEOS = {".mp4", ".mov", ".mkv", ".avi", ".webm"}
ANIMATED = (".gif", *sorted(VIDEOS))


@dataclass(frozen=True)
class Listed:
    """A line of the list."""

    name: str
    instruction: str
    path: Path
    """Folder of pictures, one animated picture, or a video."""


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
