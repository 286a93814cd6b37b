"""Folders of named arrays: ``meta.json`` beside one ``.npy`` file each, whole or refused."""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ifo_grounding.errors import UserError
from ifo_grounding.files import atomic_write, read_json, write_json

META = "meta.json"
VERSION = 1
"""Version of the format, the only one that is read."""
BLOCK_BYTES = 1 << 20
DAMAGED = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RuntimeError)
"""What arrays raise that are not what a reader takes them for, NotImplementedError among them."""


def save_folder(
    folder: str | Path, kind: str, arrays: Mapping[str, Tensor], facts: Mapping[str, Any]
) -> None:
    """Write tensors and facts (whatever JSON can say) as a folder, replacing an older one at once.

    Args:
        folder: where to; it appears when everything is written.
        kind: what the folder holds, such as ``"ifo-grounding demonstrations"``.
        arrays: tensors by name; each becomes ``name.npy``.
        facts: what else a reader needs.

    Raises:
        UserError: where the folder is a file, or holds what this function did not write, or of
            another kind.
    """
    _check_ours(Path(folder), kind)
    with atomic_write(folder) as temporary:
        temporary.mkdir()
        listed = {}
        for name, tensor in arrays.items():
            path = temporary / f"{name}.npy"
            np.save(path, tensor.detach().cpu().numpy(), allow_pickle=False)
            listed[name] = {"crc32": _checksum(path)}
        meta = {"format": kind, "version": VERSION, "arrays": listed, "facts": dict(facts)}
        write_json(temporary / META, meta)


def _check_ours(folder: Path, kind: str) -> None:
    """Raise :class:`UserError` where writing ``folder`` would delete what others put there."""
    if not folder.is_dir():
        if folder.exists():
            raise UserError(f"{folder} is a file: name a folder")
        return
    ours: set[str] = set()
    if (folder / META).exists():
        meta = read_json(folder / META)
        if isinstance(meta, dict) and meta.get("format") == kind:
            ours = {META, *(f"{name}.npy" for name in meta.get("arrays") or ())}
    if others := sorted({path.name for path in folder.iterdir()} - ours):
        raise UserError(
            f"{folder} holds {others[0]!r}, which would be deleted: name another folder, or an "
            "empty one"
        )


def load_folder(
    folder: str | Path, kind: str, names: Collection[str], optional: Collection[str] = ()
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what :func:`save_folder` wrote; tensors stay on disk and are read as they are used.

    Nothing is unpickled.

    Args:
        folder: where from.
        kind: what the folder must hold.
        names: arrays that must be there.
        optional: arrays that may be there. Others are refused.

    Raises:
        UserError: that says what is missing, damaged or foreign.
    """
    folder = Path(folder)
    if not (folder / META).is_file():
        raise UserError(f"{folder} is not a folder of {kind}: it has no {META}")
    meta = read_json(folder / META)
    found = meta.get("format") if isinstance(meta, dict) else type(meta).__name__
    if found != kind:
        raise UserError(f"{folder} holds {found!r}, not {kind!r}")
    if meta.get("version") != VERSION:
        raise UserError(
            f"{folder} is of version {meta.get('version')!r}, this library reads {VERSION}: "
            "record it again or use the library that wrote it"
        )
    listed, facts = meta.get("arrays"), meta.get("facts")
    if not isinstance(listed, dict) or not isinstance(facts, dict):
        raise UserError(f"{folder / META} lacks its arrays or facts: it is damaged")
    if missing := sorted(set(names) - set(listed)):
        raise UserError(f"{folder / META} does not list {', '.join(missing)}: it is damaged")
    if foreign := sorted(set(listed) - set(names) - set(optional)):
        raise UserError(f"{folder} holds {', '.join(foreign)}, which {kind} have no place for")
    with damaged(folder):
        return {name: _load_array(folder / f"{name}.npy", listed[name]) for name in listed}, facts


@contextlib.contextmanager
def damaged(folder: str | Path) -> Iterator[None]:
    """Say that a folder is damaged, where what was read of it makes a mistake."""
    try:
        yield
    except DAMAGED as error:
        raise UserError(f"{folder} is damaged: {error}") from None


def _load_array(path: Path, expected: Mapping[str, Any]) -> Tensor:
    if not path.is_file():
        raise UserError(f"{path.name} is missing: restore it or record the folder again")
    if _checksum(path) != expected["crc32"]:
        raise UserError(f"the checksum of {path.name} is not the one in {META}")
    try:
        return torch.from_numpy(np.load(path, mmap_mode="c", allow_pickle=False))
    except ValueError:  # an array without items cannot be mapped
        return torch.from_numpy(np.load(path, allow_pickle=False))


def _checksum(path: Path) -> int:
    checksum = 0
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            checksum = zlib.crc32(block, checksum)
    return checksum
