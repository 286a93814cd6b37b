"""Folders of named arrays: ``meta.json`` beside one ``.npy`` file each, whole or refused."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ifo_grounding.data._spool import is_mapped, pieces, release
from ifo_grounding.errors import UserError
from ifo_grounding.files import atomic_write, read_json, write_json

META = "meta.json"
BLOCK_BYTES = 1 << 20
DAMAGED = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RuntimeError)
"""What arrays raise that are not what a reader takes them for, NotImplementedError among them."""


def save_folder(
    folder: str | Path,
    kind: str,
    version: int,
    arrays: Mapping[str, Tensor],
    facts: Mapping[str, Any],
) -> None:
    """Write tensors and facts (whatever JSON can say) as a folder, replacing an older one at once.

    Args:
        folder: where to; it appears when everything is written.
        kind: what the folder holds, such as ``"ifo-grounding demonstrations"``.
        version: version of that format.
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
            _save_array(path, tensor)
            listed[name] = {
                "dtype": str(tensor.dtype).removeprefix("torch."),
                "shape": list(tensor.shape),
                "bytes": path.stat().st_size,
                "crc32": _checksum(path),
            }
        write_json(
            temporary / META,
            {"format": kind, "version": version, "arrays": listed, "facts": dict(facts)},
        )


def _check_ours(folder: Path, kind: str) -> None:
    """Raise :class:`UserError` where writing ``folder`` would delete what others put there."""
    if not folder.is_dir():
        if folder.exists():
            raise UserError(f"{folder} is a file: name a folder")
        return
    try:
        found = sorted(path.name for path in folder.iterdir())
        meta: Any = read_json(folder / META) if META in found else None
    except FileNotFoundError:  # another writer has just put it away
        return
    except UserError:
        if not (folder / META).exists():
            return
        raise
    ours = isinstance(meta, dict) and meta.get("format") == kind
    arrays = meta.get("arrays") if ours else None
    listed = {f"{name}.npy" for name in arrays} if isinstance(arrays, dict) else set()
    if others := [name for name in found if name not in listed and not (ours and name == META)]:
        raise UserError(
            f"{folder} holds {others[0]!r}, which would be deleted: name another folder, or an "
            "empty one"
        )


def load_folder(
    folder: str | Path,
    kind: str,
    version: int,
    names: Collection[str],
    optional: Collection[str] = (),
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what :func:`save_folder` wrote; tensors stay on disk and are read as they are used.

    Args:
        folder: where from.
        kind: what the folder must hold.
        version: the only version that is read.
        names: arrays that must be there.
        optional: arrays that may be there. Others are refused.

    Raises:
        UserError: that says what is missing, damaged or foreign.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder of {kind}")
    if not (folder / META).exists():
        raise UserError(f"{folder} is not a folder of {kind}: it has no {META}")
    meta = read_json(folder / META)
    if not isinstance(meta, dict) or meta.get("format") != kind:
        found = meta.get("format") if isinstance(meta, dict) else type(meta).__name__
        raise UserError(f"{folder} holds {found!r}, not {kind!r}")
    if meta.get("version") != version:
        raise UserError(
            f"{folder} is of version {meta.get('version')!r}, this library reads {version}: "
            "record it again or use the library that wrote it"
        )
    listed, facts = meta.get("arrays"), meta.get("facts")
    if not isinstance(listed, dict) or not isinstance(facts, dict):
        raise UserError(f"{folder / META} lacks its arrays or facts: it is damaged")
    if missing := sorted(set(names) - set(listed)):
        raise UserError(f"{folder / META} does not list {', '.join(missing)}: it is damaged")
    if foreign := sorted(set(listed) - set(names) - set(optional)):
        raise UserError(f"{folder} holds {', '.join(foreign)}, which {kind} have no place for")
    try:
        arrays = {name: _load_array(folder / f"{name}.npy", listed[name]) for name in listed}
    except FileNotFoundError:
        raise UserError(f"{folder} was replaced while it was read: read it again") from None
    return arrays, facts


def _save_array(path: Path, tensor: Tensor) -> None:
    array = tensor.detach().cpu().numpy()
    if not is_mapped(tensor):
        np.save(path, array, allow_pickle=False)
        return
    with path.open("wb") as target:
        header = np.lib.format.header_data_from_array_1_0(array)
        np.lib.format.write_array_header_1_0(target, header)
        for piece in pieces(tensor):
            target.write(piece.numpy().data)
            release(tensor)


def fact(facts: Mapping[str, Any], name: str, kinds: type | tuple[type, ...]) -> Any:
    """Return one fact, or refuse the folder where it is missing or of another type."""
    if not isinstance(facts.get(name), kinds) or name not in facts:
        raise UserError(f"{META} has no usable {name!r} (found {facts.get(name)!r}): it is damaged")
    return facts[name]


def _load_array(path: Path, expected: Any) -> Tensor:
    if not isinstance(expected, dict):
        raise UserError(f"{path.parent / META} describes {path.name} wrongly: it is damaged")
    if not path.exists():
        raise UserError(f"{path} is missing: restore it or record the folder again")
    size = path.stat().st_size
    if size != expected.get("bytes"):
        raise UserError(
            f"{path} has {size} bytes, {META} says {expected.get('bytes')}: "
            "it is truncated or foreign"
        )
    if _checksum(path) != expected.get("crc32"):
        raise UserError(f"{path} is damaged: its checksum differs from the one in {META}")
    try:
        mode: Literal["c"] | None = "c" if _has_items(expected) else None
        array = np.load(path, mmap_mode=mode, allow_pickle=False)
        tensor = torch.from_numpy(array)
    except (ValueError, TypeError, EOFError, OSError) as error:
        raise UserError(f"{path} is not a readable .npy file: {error}") from None
    found = (str(tensor.dtype).removeprefix("torch."), list(tensor.shape))
    if found != (expected.get("dtype"), expected.get("shape")):
        raise UserError(
            f"{path} holds {found[0]} {found[1]}, {META} says "
            f"{expected.get('dtype')} {expected.get('shape')}"
        )
    return tensor


def _has_items(expected: Mapping[str, Any]) -> bool:
    """Tell whether an array has any items: an empty one cannot be mapped into memory."""
    shape = expected.get("shape")
    return isinstance(shape, list) and all(shape)


def _checksum(path: Path) -> int:
    checksum = 0
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            checksum = zlib.crc32(block, checksum)
    return checksum
