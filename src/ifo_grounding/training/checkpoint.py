"""Checkpoints that a killed run continues from to the same result.

Both training loops draw all their randomness from ``derive(seed, name, iteration)``, so that a
checkpoint at an iteration's end needs no generator states beyond the weights, the optimizer and
the counters: they are functions of what it holds.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import time
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import torch

from ifo_grounding.errors import UserError
from ifo_grounding.files import atomic_write

FORMAT = "ifo-grounding checkpoint 1"


def fingerprint(*settings: Any) -> str:
    """Return a short hash of settings (dataclasses or JSON values) that decide a run's result.

    >>> fingerprint({"lr": 0.1}) == fingerprint({"lr": 0.1}), fingerprint(1) == fingerprint(2)
    (True, False)
    """
    plain = [asdict(s) if is_dataclass(s) and not isinstance(s, type) else s for s in settings]
    text = json.dumps(plain, sort_keys=True, default=str)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


class Checkpoint:
    """One file that holds the state of named parts of a run.

    Args:
        path: the file.
        settings: :func:`fingerprint` of what decides the result; a checkpoint with another
            fingerprint is refused.
        parts: objects with ``state_dict`` and ``load_state_dict``.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "checkpoint.pt"
    >>> layer = torch.nn.Linear(2, 1)
    >>> Checkpoint(path, "a", layer=layer).save({"iteration": 3})
    >>> Checkpoint(path, "a", layer=torch.nn.Linear(2, 1)).load()
    {'iteration': 3}
    """

    def __init__(self, path: str | Path, settings: str, **parts: Any) -> None:
        self.path, self.settings, self.parts = Path(path), settings, parts
        self._begun = time.monotonic()

    def save(self, progress: dict[str, Any]) -> None:
        """Write all parts and ``progress`` (numbers, strings, lists, dicts, tensors)."""
        content = {
            "format": FORMAT,
            "settings": self.settings,
            "progress": progress,
            "seconds": time.monotonic() - self._begun,
            "parts": {name: part.state_dict() for name, part in self.parts.items()},
        }
        with atomic_write(self.path) as temporary:
            torch.save(content, temporary)

    def load(self) -> dict[str, Any] | None:
        """Restore all parts and return the progress, or None where there is no checkpoint.

        Raises:
            UserError: where the file is damaged, foreign, or of a run with other settings or parts.
        """
        if not self.path.exists():
            return None
        content = _read(self.path)
        if content["settings"] != self.settings:
            raise UserError(
                f"{self.path} belongs to a run with other settings: give this run another name, "
                "restore the settings, or delete the checkpoint to start over"
            )
        held, wanted = set(content["parts"]), set(self.parts)
        if held != wanted:
            raise UserError(
                f"{self.path} holds {', '.join(sorted(held))}, here there is "
                f"{', '.join(sorted(wanted))}: give this run another name, go on with the same "
                "parts, or delete the checkpoint to start over"
            )
        for name, part in self.parts.items():
            try:
                part.load_state_dict(content["parts"][name])
            except (KeyError, RuntimeError, TypeError, ValueError) as error:
                raise UserError(
                    f"{self.path} holds another {name} than this run has ({_reason(error)}): give "
                    "this run another name, or delete the checkpoint to start over"
                ) from error
        self._begun = time.monotonic() - content.get("seconds", 0.0)
        return content["progress"]

    def delete(self) -> None:
        """Remove the file, if there is one."""
        self.path.unlink(missing_ok=True)


def spent(path: str | Path) -> float:
    """Return the seconds of work that a checkpoint holds, 0 where it cannot be read."""
    try:
        return float(_read(Path(path), mmap=True).get("seconds", 0.0))
    except UserError:  # whoever continues from it says what is wrong
        return 0.0


def _read(path: Path, mmap: bool = False) -> dict[str, Any]:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except (RuntimeError, EOFError, OSError, ValueError, pickle.UnpicklingError) as error:
        raise UserError(f"{path} is damaged ({_reason(error)}): delete it to start over") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise UserError(f"{path} is no checkpoint of this library: delete it")
    return content


def _reason(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
