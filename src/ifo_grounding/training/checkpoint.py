"""Checkpoints that a killed run continues from to the same result.

Both training loops draw all their randomness from ``derive(seed, name, iteration)``: a checkpoint
at an iteration's end holds no generator states.
"""

from __future__ import annotations

import json
import time
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch

from ifo_grounding.errors import UserError, first_line
from ifo_grounding.files import atomic_write, regular_file, unwritable

FORMAT = "ifo-grounding checkpoint 2"
HELD = {"settings": dict, "progress": dict, "seconds": float, "parts": dict}
"""What a checkpoint holds besides its format."""


def difference(
    made: Mapping[str, Any], asked: Mapping[str, Any], free: Collection[str] = ()
) -> str | None:
    """Return how nested settings differ from those that something was made with, None if not.

    ``free`` names settings or whole sections, with dots, that may differ. A setting that only one
    side has may be missing on the other where its value is None.

    >>> difference({"imitate": {"steps": 900}}, {"imitate": {"steps": 10}})
    'made with imitate.steps=900, not 10: leave it out'
    >>> difference({"imitate": {"steps": 900}}, {"imitate": {"steps": 10}}, free=["imitate"])
    >>> difference({"world": {"id": "a", "split": "all"}}, {"world": {"id": "b"}})
    'made with world.id=a, not b: leave it out'
    """
    before, now = leaves(made), leaves(asked)
    both = [name for name in before if name in now]  # what another world lacks says less
    for name in dict.fromkeys([*both, *before, *now]):
        there, here = before.get(name), now.get(name)
        if there == here or any(f"{name}.".startswith(f"{each}.") for each in free):
            continue
        if name in before and name in now:
            return f"made with {name}={written(there)}, not {written(here)}: leave it out"
        version = f"with {name}" if name in before else f"without {name}"
        return f"made by another version, {version}: install that one"
    return None


def leaves(settings: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """Return all settings that are no sections by their dotted names, such as ``imitate.lr``."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            found |= leaves(value, f"{section}{name}.")
        else:
            found[f"{section}{name}"] = list(value) if isinstance(value, tuple) else value
    return found


def written(value: Any) -> str:
    """Return a value as it is written on a command line.

    >>> written(None), written(True), written("pick"), written([1, 2])
    ('null', 'true', 'pick', '[1, 2]')
    """
    return value if isinstance(value, str) else json.dumps(value, default=str)


class Checkpoint:
    """One file that holds the state of named parts of a training loop.

    Args:
        settings: what decides the result; a checkpoint of other settings is refused.
        parts: objects with ``state_dict`` and ``load_state_dict``.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "checkpoint.pt"
    >>> layer = torch.nn.Linear(2, 1)
    >>> Checkpoint(path, {"lr": 0.1}, layer=layer).save({"iteration": 3})
    >>> Checkpoint(path, {"lr": 0.1}, layer=torch.nn.Linear(2, 1)).load()
    {'iteration': 3}
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any], **parts: Any) -> None:
        self.path, self.settings, self.parts = Path(path), dict(settings), parts
        self._begun = time.monotonic()

    def save(self, progress: dict[str, Any]) -> None:
        """Write all parts and ``progress`` (numbers, strings, lists, dicts, tensors).

        Raises:
            UserError: where the file cannot be written, such as on a full disk.
        """
        content = {
            "format": FORMAT,
            "settings": self.settings,
            "progress": progress,
            "seconds": time.monotonic() - self._begun,
            "parts": {name: part.state_dict() for name, part in self.parts.items()},
        }
        try:
            with atomic_write(self.path) as temporary:
                torch.save(content, temporary)
        except (OSError, RuntimeError) as error:  # PyTorch's writer raises a RuntimeError
            raise unwritable(self.path, first_line(error)) from error

    def load(self) -> dict[str, Any] | None:
        """Restore all parts and return the progress, or None where there is no checkpoint.

        Raises:
            UserError: where the file is damaged, foreign, or of other settings or parts.
        """
        if not self.path.exists():
            return None
        content = _read(self.path)
        over = "or delete it to start over"
        if found := difference(content["settings"], self.settings):
            raise UserError(f"{self.path} was {found}, give another path, {over}")
        held, wanted = set(content["parts"]), set(self.parts)
        if held != wanted:
            raise UserError(
                f"{self.path} holds {', '.join(sorted(held))}, here there is "
                f"{', '.join(sorted(wanted))}: go on with the same parts, {over}"
            )
        for name, part in self.parts.items():
            try:
                part.load_state_dict(content["parts"][name])
            except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
                raise UserError(
                    f"{self.path} holds another {name} than this run has ({first_line(error)}): "
                    f"give this run another name, {over}"
                ) from error
        self._begun = time.monotonic() - content["seconds"]
        return content["progress"]


def spent(path: Path) -> float:
    """Return the seconds of work that a checkpoint holds, 0 where it cannot be read."""
    try:
        return float(_read(path)["seconds"])
    except UserError:  # whoever continues from it says what is wrong
        return 0.0


def _read(path: Path) -> dict[str, Any]:
    """Return what a checkpoint file holds."""
    try:
        with zipfile.ZipFile(regular_file(path)) as archive:
            if damaged := archive.testzip():  # PyTorch does not compare checksums
                raise zipfile.BadZipFile(f"the checksum of {damaged} is another")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # flipped bits raise whatever the reader stumbles over
        why = first_line(error)
        raise UserError(f"{path} is damaged ({why}): delete it to start over") from None
    known = isinstance(content, dict) and content.get("format") == FORMAT
    if not known or any(not isinstance(content.get(k), kind) for k, kind in HELD.items()):
        raise UserError(f"{path} is no checkpoint of this version: delete it to start over")
    return content
