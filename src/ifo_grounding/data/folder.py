"""Folders of named arrays: ``meta.json`` beside one ``.npy`` file each, whole or refused."""

from __future__ import annotations

import contextlib
import json
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
DAMAGED = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RuntimeError)
"""What arrays raise that are not what a reader takes them for, NotImplementedError among them."""


def save_folder(
    folder: str | Path, kind: str, arrays: Mapping[str, Tensor], facts: Mapping[str, Any]
) -> None:
    """Write tensors and facts (whatever JSON can say) as a folder, replacing an older one at once.

    ``kind`` says what the folder holds, such as ``"ifo-grounding demonstrations"``.

    Raises:
        UserError: where the folder is a file, or holds what is not of this kind, which would be
            deleted.
    """
    with atomic_write(vacant(folder, kind)) as temporary:
        temporary.mkdir()
        listed = {}
        for name, tensor in arrays.items():
            path = temporary / f"{name}.npy"
            np.save(path, tensor.detach().cpu().numpy(), allow_pickle=False)
            listed[name] = {"crc32": zlib.crc32(np.memmap(path, mode="r").data)}
        meta = {"format": kind, "version": VERSION, "arrays": listed, "facts": dict(facts)}
        meta["facts_crc32"] = _checksum(facts)
        write_json(temporary / META, meta)


def vacant(folder: str | Path, kind: str | None = None) -> Path:
    """Return a folder that is written next; refuse one that holds more than this kind."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder} is a file: name a folder")
    ours: set[str] = set()
    if kind is not None and (folder / META).exists():
        meta = read_json(folder / META)
        if isinstance(meta, dict) and meta.get("format") == kind:
            ours = {META, *(f"{name}.npy" for name in meta.get("arrays") or ())}
    if others := sorted({path.name for path in folder.glob("*")} - ours):
        raise UserError(
            f"{folder} holds {others[0]!r}, which would be deleted: name another folder, or an "
            "empty one"
        )
    return folder


def load_folder(
    folder: str | Path, kind: str, names: Collection[str], optional: Collection[str] = ()
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what :func:`save_folder` wrote; tensors stay on disk and are read as they are used.

    Nothing is unpickled. Arrays that are neither among ``names`` nor ``optional`` are refused.

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
    with damaged(folder):
        listed, facts = dict(meta["arrays"]), dict(meta["facts"])
        if meta.get("facts_crc32") not in (None, _checksum(facts)):  # older folders have none
            raise UserError(f"the checksum of the facts in {META} is another")
        if missing := sorted(set(names) - set(listed)):
            raise UserError(f"{META} does not list {', '.join(missing)}")
        if foreign := sorted(set(listed) - {*names, *optional}):
            raise UserError(f"it holds {', '.join(foreign)}, which {kind} have no place for")
        return {name: _load_array(folder / f"{name}.npy", listed[name]) for name in listed}, facts


def _checksum(facts: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(dict(facts), sort_keys=True).encode())


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
    if zlib.crc32(np.memmap(path, mode="r").data) != expected["crc32"]:
        raise UserError(f"the checksum of {path.name} is not the one in {META}")
    try:
        return torch.from_numpy(np.load(path, mmap_mode="c", allow_pickle=False))
    except ValueError:  # an array without items cannot be mapped
        return torch.from_numpy(np.load(path, allow_pickle=False))
