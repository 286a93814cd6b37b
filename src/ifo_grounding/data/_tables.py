"""Tables of others (Arrow, Parquet), of which a few rows are in memory at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ifo_grounding.data._episodes import check_size
from ifo_grounding.errors import optional
from ifo_grounding.files import regular_file


def open_table(path: Path, kind: str = "parquet", **options: Any) -> Any:
    """Open a folder of files; what is no regular file among them, as a pipe, is an OSError."""
    for file in filter(lambda file: not file.is_dir(), path.rglob("*")):
        regular_file(file)
    return optional("pyarrow.dataset", extra="datasets").dataset(path, format=kind, **options)


def read_episode(table: Any, **chosen: Any) -> Any:
    """Return what is chosen of a table, the frames of one episode; refuse too many of them."""
    read: list[Any] = []
    for batch in table.to_batches(batch_size=256, **chosen):
        read.append(batch)
        check_size(sum(part.num_rows for part in read), sum(part.nbytes for part in read))
    return optional("pyarrow", extra="datasets").Table.from_batches(read)
