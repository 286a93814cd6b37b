"""Rows that come piece by piece: in memory while they are few, in a file where they are many."""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Callable
from typing import IO

import torch
from torch import Tensor

from ifo_grounding.files import home

MEMORY_BYTES = 128 << 20
"""What may be in memory of one table of rows, or of one dictionary of tiles."""
PIECE_BYTES = 16 << 20


class Spool:
    """Collects pieces [n, *S] of one table; beyond ``MEMORY_BYTES`` they go to a scratch file.

    The file lies in :func:`~ifo_grounding.files.home` and has no name: none is left behind,
    whatever becomes of the process.

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
        self._file: IO[bytes] | None = None

    def append(self, piece: Tensor) -> None:
        """Add rows, of any type of integer."""
        self._waiting.append(piece)
        self._bytes += piece.nbytes
        if self._bytes <= MEMORY_BYTES:
            return
        if self._file is None:
            home().mkdir(parents=True, exist_ok=True)
            self._file = tempfile.TemporaryFile(dir=home())  # noqa: SIM115  it lives on
        for each in self._waiting:
            self._file.write(each.contiguous().numpy().data)
            self._written.append((each.shape, each.dtype))
        self._waiting.clear()

    def map(self, function: Callable[[Tensor], Tensor]) -> Spool:
        """Move all pieces to another spool, changed; this one is empty afterwards."""
        changed = Spool()
        if self._file is not None:
            self._file.seek(0)
            for shape, dtype in self._written:
                content = bytearray(self._file.read(shape.numel() * dtype.itemsize))
                changed.append(function(torch.frombuffer(content, dtype=dtype).view(shape)))
        while self._waiting:
            changed.append(function(self._waiting.pop(0)))
        return changed

    def tensor(self, dtype: torch.dtype) -> Tensor:
        """Return all rows as one tensor, mapped where they are in a file; empties the spool."""
        if self._file is None:
            return join(self._waiting, dtype)
        if any(found != dtype for _, found in self._written):
            return self.map(lambda piece: piece.to(dtype)).tensor(dtype)
        rows = sum(shape[0] for shape, _ in self._written)
        self._file.flush()
        mapping = mmap.mmap(self._file.fileno(), 0)  # it keeps the file
        return torch.frombuffer(mapping, dtype=dtype).view(rows, *self._written[0][0][1:])


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
    spool = Spool()
    for some in rows.split(_rows_per_piece(table)):
        spool.append(table[some])
    return spool.tensor(table.dtype)


def same_rows(table: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Tell whether rows ``first`` and ``second`` [N] of a table are equal, bool [N]."""
    size = _rows_per_piece(table)
    pairs = zip(first.split(size), second.split(size), strict=True)
    return torch.cat([(table[one] == table[other]).flatten(1).all(1) for one, other in pairs])


def _rows_per_piece(table: Tensor) -> int:
    return max(1, PIECE_BYTES // max(table.shape[1:].numel() * table.element_size(), 1))
