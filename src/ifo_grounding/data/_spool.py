"""Rows that come piece by piece: in memory while they are few, in a file where they are many."""

from __future__ import annotations

import contextlib
import mmap
import os
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ifo_grounding.files import scratch_file

MEMORY_BYTES = 128 << 20
"""What may be in memory of one table of rows, or of one dictionary of tiles."""
PIECE_BYTES = 16 << 20

_MAPPINGS: weakref.WeakValueDictionary[int, mmap.mmap] = weakref.WeakValueDictionary()
"""Of each table that is in a file: its mapping, by the address of its first item."""


class Spool:
    """Collects pieces [n, *S] of one table; beyond ``MEMORY_BYTES`` they go to a scratch file.

    >>> spool = Spool()
    >>> spool.append(torch.zeros(2, 3, dtype=torch.uint8))
    >>> spool.append(torch.full((1, 3), 300, dtype=torch.int16))
    >>> spool.tensor(torch.int16).tolist()
    [[0, 0, 0], [0, 0, 0], [300, 300, 300]]
    """

    def __init__(self) -> None:
        self._waiting: list[Tensor] = []
        self._bytes = 0
        self._written: list[tuple[torch.Size, torch.dtype]] = []
        self._path: Path | None = None

    def append(self, piece: Tensor) -> None:
        """Add rows, of any type of integer."""
        self._waiting.append(piece)
        self._bytes += piece.nbytes
        if self._bytes > MEMORY_BYTES:
            self._write()

    def map(self, function: Callable[[Tensor], Tensor]) -> Spool:
        """Move all pieces to another spool, changed; this one is empty afterwards."""
        changed = Spool()
        for piece in self._drain():
            changed.append(function(piece))
        return changed

    def tensor(self, dtype: torch.dtype) -> Tensor:
        """Return all rows as one tensor, mapped where they are in a file; empties the spool.

        The file has no name any more, so that whatever becomes of the process leaves none.
        """
        if self._path is None:
            return join(self._waiting, dtype)
        if any(found != dtype for _, found in self._written):
            return self.map(lambda piece: piece.to(dtype)).tensor(dtype)
        rows = sum(shape[0] for shape, _ in self._written)
        with self._path.open("r+b") as file:
            mapping = mmap.mmap(file.fileno(), 0)
        self._remover()
        self._path = None
        mapped = torch.frombuffer(mapping, dtype=dtype).view(rows, *self._written[0][0][1:])
        _MAPPINGS[mapped.data_ptr()] = mapping
        return mapped

    def _write(self) -> None:
        if self._path is None:
            self._path = scratch_file()
            self._remover = weakref.finalize(self, _remove, self._path, os.getpid())
        with self._path.open("ab") as file:
            for piece in self._waiting:
                piece.contiguous().numpy().tofile(file)
                self._written.append((piece.shape, piece.dtype))
        self._waiting.clear()

    def _drain(self) -> Iterator[Tensor]:
        if self._path is not None:
            with self._path.open("rb") as file:
                for shape, dtype in self._written:
                    kind = str(dtype).removeprefix("torch.")
                    rows = np.fromfile(file, kind, shape.numel())
                    yield torch.from_numpy(rows).view(shape)
            self._remover()
        while self._waiting:
            yield self._waiting.pop(0)


def _remove(path: Path, process: int) -> None:
    """Remove a file, but not from a fork of the process that made it."""
    if os.getpid() == process:
        with contextlib.suppress(PermissionError):  # Windows keeps what is mapped
            path.unlink(missing_ok=True)


def is_mapped(table: Tensor) -> bool:
    """Tell whether a table is the beginning of what a :class:`Spool` keeps in a file."""
    return table.data_ptr() in _MAPPINGS and table.is_contiguous()


def release(table: Tensor) -> None:
    """Give back the memory of a table that is in a file; what is used again is read again."""
    if (mapping := _MAPPINGS.get(table.data_ptr())) and hasattr(mmap, "MADV_DONTNEED"):
        mapping.madvise(mmap.MADV_DONTNEED)


def join(parts: list[Tensor], dtype: torch.dtype) -> Tensor:
    """Concatenate rows as ``dtype``; the list is emptied, so that not both are in memory."""
    if len(parts) == 1:
        return parts.pop().to(dtype)
    joined = torch.empty(sum(map(len, parts)), *parts[0].shape[1:], dtype=dtype)
    end = len(joined)
    while parts:
        part = parts.pop()
        joined[end - len(part) : end] = part
        end -= len(part)
    return joined


def take(table: Tensor, rows: Tensor) -> Tensor:
    """Return rows [N, *S] of a table, in a scratch file where they are too many for memory."""
    if len(rows) * _row_bytes(table) <= MEMORY_BYTES:
        return table[rows]
    spool = Spool()
    for some in rows.split(_rows_per_piece(table)):
        spool.append(table[some])
    return spool.tensor(table.dtype)


def pieces(table: Tensor) -> tuple[Tensor, ...]:
    """Cut a table into pieces of some ``PIECE_BYTES``."""
    return table.split(_rows_per_piece(table))


def same_rows(table: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Tell whether rows ``first`` and ``second`` [N] of a table are equal, bool [N]."""
    size = _rows_per_piece(table)
    pairs = zip(first.split(size), second.split(size), strict=True)
    return torch.cat([(table[one] == table[other]).flatten(1).all(1) for one, other in pairs])


def _row_bytes(table: Tensor) -> int:
    return table.shape[1:].numel() * table.element_size()


def _rows_per_piece(table: Tensor) -> int:
    return max(1, PIECE_BYTES // max(_row_bytes(table), 1))
