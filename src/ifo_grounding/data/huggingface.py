"""Demonstrations from and to Hugging Face ``datasets``: one row per episode."""

from __future__ import annotations

import itertools
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from ifo_grounding.data._episodes import Episode, naming
from ifo_grounding.data._images import BROKEN, stack_images
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.pictures import TRUNCATED, rgb, written_sentences
from ifo_grounding.errors import UserError, optional
from ifo_grounding.progress import progress_bar

if TYPE_CHECKING:
    import datasets

FRAMES, INSTRUCTION = "frames", "instruction"


def from_huggingface(
    dataset: datasets.Dataset | datasets.IterableDataset | Iterable[Mapping[str, Any]],
    *,
    frames: str = FRAMES,
    instruction: str = INSTRUCTION,
    progress: bool = False,
    **options: Any,
) -> Demonstrations:
    """Read a dataset with one row per episode, row by row.

    Only the two columns that are named are read, whatever else there is, and ``truncated``, which
    says of a recording that it was cut.

    Args:
        dataset: one split as a ``Dataset`` or ``IterableDataset``, or rows from anywhere. An
            episode's frames are pictures (of Pillow, or PNG or JPEG as ``{"bytes": ...}``), or
            one array, uint8 [T + 1, C, H, W], such as a column ``Array4D``. Of paths, files of this
            machine are opened.
        frames: name of the column of frames.
        instruction: name of the column of instructions.
        options: for :meth:`Demonstrations.from_episodes`.

    Raises:
        UserError: where a column is missing, or an episode is not as it has to be, with the number
            of its row.

    >>> shown = [Image.new("RGB", (48, 48), colour) for colour in ("red", "blue")]
    >>> from_huggingface([{"frames": shown, "instruction": "go on"}]).lengths
    tensor([3])
    """
    if isinstance(dataset, str) or not isinstance(dataset, Iterable):
        raise UserError(
            f"{dataset!r:.80} is a {type(dataset).__name__}: give the dataset itself, such as "
            "datasets.load_dataset(...) or datasets.load_from_disk(...) returns"
        )
    rows = progress_bar(_selected(dataset, frames, instruction), desc="read", shown=progress)
    return Demonstrations.from_episodes(_episodes(rows, frames, instruction), **options)


def _selected(dataset: Any, frames: str, instruction: str) -> Iterable[Mapping[str, Any]]:
    """Leave the columns that are read, arrays as bytes; other iterables stay as they are."""
    if isinstance(dataset, Mapping):
        splits = ", ".join(map(repr, dataset))
        raise UserError(f"choose one of the splits: dataset[...] with {splits}")
    if not hasattr(dataset, "select_columns"):
        return dataset
    further = {TRUNCATED} & {*(dataset.column_names or ())}
    try:
        selected = dataset.select_columns([frames, instruction, *further])
    except ValueError as error:
        raise UserError(f"{error}: name them with frames=... and instruction=...") from None
    feature: Any = (dataset.features or {}).get(frames)
    while hasattr(feature, "feature"):  # lists of lists
        feature = feature.feature
    if getattr(feature, "dtype", None) == "uint8":
        rows = selected.with_format("numpy")
        return ({**row, frames: _as_bytes(row[frames])} for row in rows)
    if type(feature).__name__ == "Video":
        raise UserError(
            f"{frames!r} is a column of videos, which are read from files alone: write them beside "
            "a list of episodes for load_pictures (with the extra video)"
        )
    # Pictures as they are stored: to decode them, datasets opens whatever address a row names.
    return (table.to_pylist()[0] for table in selected.with_format("arrow"))


def _as_bytes(shown: Any) -> Any:
    """Return an array as bytes again: ``datasets`` reads them as int64, and NaN for none."""
    kind = np.asarray(shown).dtype.kind
    return shown.astype(np.uint8) if kind == "i" else None if kind == "f" else shown


def _episodes(
    rows: Iterable[Mapping[str, Any]], frames: str, instruction: str
) -> Iterator[Episode]:
    rest = iter(rows)
    for number in itertools.count():
        try:
            row = next(rest)
        except StopIteration:
            return
        except BROKEN as error:  # datasets cannot decode a picture
            raise UserError(f"episode {number} cannot be read ({error})") from None
        if missing := {frames, instruction} - set(row if isinstance(row, Mapping) else ()):
            raise UserError(f"episode {number} has no {' and no '.join(sorted(missing))}")
        shown = row[frames]
        if isinstance(shown, Image.Image | Mapping):
            raise UserError(
                f"episode {number} is a single picture, but a row is one episode: group the rows "
                "of an episode, so that its frames are a list of pictures"
            )
        shown = [shown] if isinstance(shown, str | Path) else shown
        # None stands where a picture is missing.
        if isinstance(shown, Sequence) and any(
            isinstance(one, Image.Image | Mapping | str | Path | None) for one in shown
        ):
            with naming(number):
                shown = stack_images(map(_source, itertools.count(), shown))
        yield number, shown, row[instruction], bool(row.get(TRUNCATED))


def _source(step: int, picture: Any) -> tuple[str, Any]:
    """Return the name of a frame and what to read it from."""
    if isinstance(picture, str | Path):
        raise UserError(f"it names a file, {str(picture)!r:.80}, as load_pictures reads them")
    if isinstance(picture, Mapping):
        content, path = picture.get("bytes"), picture.get("path")
        picture = content if path is None or content is not None else Path(path)
    return f"frame {step}", picture


def to_huggingface(
    demos: Demonstrations, *, cache_dir: str | Path | None = None
) -> datasets.Dataset:
    """Turn demonstrations into a dataset: ``frames``, ``instruction``, and which were truncated.

    Frames are PNG files, without loss; grey ones become RGB. Rows are written a few at a time:
    ``save_to_disk``, ``to_parquet`` or ``push_to_hub`` carry them on.

    Args:
        cache_dir: where rows are written; by default the cache of ``datasets``.

    Raises:
        UserError: where ``datasets`` is missing, there is no demonstration or no vocabulary, or
            frames are no pictures.
    """
    datasets = optional("datasets", extra="datasets")
    sentences = written_sentences(demos)

    def rows() -> Iterator[dict[str, Any]]:
        for number, (sentence, cut) in enumerate(zip(sentences, demos.cut.tolist(), strict=True)):
            shown = map(Image.fromarray, rgb(demos[number]["pixels"]))
            yield {FRAMES: list(shown), INSTRUCTION: sentence, TRUNCATED: cut}

    columns = {
        FRAMES: datasets.Sequence(datasets.Image()),
        INSTRUCTION: datasets.Value("string"),
        TRUNCATED: datasets.Value("bool"),
    }
    return datasets.Dataset.from_generator(
        rows,
        features=datasets.Features(columns),
        cache_dir=None if cache_dir is None else str(cache_dir),
        # Without a name of its own, the dataset would be named by a hash of the pickled pixels.
        fingerprint=uuid.uuid4().hex,
        writer_batch_size=16,
    )
