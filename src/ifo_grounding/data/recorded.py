"""A folder of demonstrations that were recorded elsewhere, in one of three forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.folder import META
from ifo_grounding.data.lerobot import INFO, load_lerobot
from ifo_grounding.data.pictures import LIST, load_pictures, read_list
from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json


def load_recorded(folder: Path, **options: Any) -> Demonstrations:
    """Read a folder of pictures or of LeRobot, or what ``Demonstrations.save`` wrote.

    Raises:
        UserError: where it is neither.
    """
    form = _form(folder)
    if form == META:
        return Demonstrations.load(folder)
    return (load_pictures if form == LIST else load_lerobot)(folder, **options)


def count_recorded(folder: Path) -> int:
    """Return how many demonstrations such a folder holds."""
    form = _form(folder)
    if form == INFO:
        return int(read_json(folder / INFO, dict, ["total_episodes"])["total_episodes"])
    return len(read_list(folder) if form == LIST else Demonstrations.load(folder))


def _form(folder: Path) -> str:
    """Return the file that tells a folder's form."""
    if not folder.is_dir():
        raise UserError(f"recorded={folder} is no folder of demonstrations")
    for name in (LIST, INFO, META):
        if (folder / name).exists():
            return name
    raise UserError(
        f"{folder} holds no demonstrations: it has no {LIST}, as a folder of pictures or videos, "
        f"no {INFO}, as one of LeRobot, and no {META}, as Demonstrations.save() writes it"
    )
