"""Demonstrations from and to folders of LeRobot's format v3: without its package or its actions."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from ifo_grounding.data._episodes import Episode, naming
from ifo_grounding.data._images import Source, stack_images
from ifo_grounding.data._tables import open_table, read_episode
from ifo_grounding.data._video import read_video
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.folder import DAMAGED
from ifo_grounding.data.pictures import (
    FRAMES_PER_SECOND,
    TRUNCATED,
    new_folder,
    rgb,
    written_sentences,
)
from ifo_grounding.errors import UserError, at_least_one, check_choice, optional
from ifo_grounding.files import atomic_write, read_json, regular_file, write_json

INFO, EPISODES, VERSION = "meta/info.json", "meta/episodes", "v3.0"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
VIDEO = f"videos/{{video_key}}/{FILE}.mp4"
CAMERA = "observation.image"
IMAGE = ["height", "width", "channels"]
NUMBERS = ("frame_index", "episode_index", "index", "task_index")


def load_lerobot(
    folder: str | Path,
    *,
    camera: str | None = None,
    stride: int = 1,
    size: tuple[int, int] | None = None,
    progress: bool = False,
    **options: Any,
) -> Demonstrations:
    """Read a folder of LeRobot's format v3: what one camera saw, and the task of each episode.

    Actions and states are never read. It needs the extra ``datasets``, and ``video`` for videos.

    Args:
        folder: where from.
        camera: name of the camera, where there are several.
        stride: of so many frames one is taken, counted back from the last one.
        size: height and width that frames are scaled to; by default they stay as they are.
        progress: whether to show a bar.
        options: for :meth:`Demonstrations.from_episodes`: ``vocabulary``, ``length``,
            ``tile_size``, ``close``.

    Raises:
        UserError: where the folder is of another format or damaged, the camera is none of its own,
            or an episode is not as it has to be, with its number.
    """
    stride = at_least_one("stride", stride)

    def episodes() -> Iterator[Episode]:
        seen = _Camera(Path(folder), camera)
        for row in tqdm(seen.episodes(), desc="read", disable=not progress):
            number, tasks, length = (row[name] for name in ("episode_index", "tasks", "length"))
            with naming(number):
                if len(tasks) != 1:
                    raise UserError(f"it has {len(tasks)} tasks: a demonstration follows one")
                steps = range((length - 1) % stride, length, stride)
                frames = stack_images(seen.frames(row, steps), size=size)
            yield number, frames, tasks[0], bool(row.get(TRUNCATED))

    try:
        return Demonstrations.from_episodes(episodes(), **options)
    except UserError:
        raise
    except (OSError, *DAMAGED) as error:
        raise UserError(f"{folder} cannot be read as LeRobot's {VERSION} ({error})") from None


class _Camera:
    """What a camera saw, in videos that go on from episode to episode, or in a table."""

    def __init__(self, folder: Path, name: str | None) -> None:
        info = read_json(regular_file(folder / INFO))
        if info["codebase_version"] != VERSION or info.get("video_path") not in (None, VIDEO):
            raise UserError(
                f"{folder} is of LeRobot's format {info['codebase_version']}, or laid out in its "
                f"own way: convert it to {VERSION} with LeRobot's tools"
            )
        kinds = {name: feature["dtype"] for name, feature in info["features"].items()}
        cameras = [name for name, kind in kinds.items() if kind in ("image", "video")]
        name = cameras[0] if name is None and len(cameras) == 1 else name
        check_choice("camera", name, cameras)
        self.folder, self.name, self.fps = folder, name, float(info["fps"])
        self.table = open_table(folder / "data") if kinds[name] == "image" else None
        places = ("chunk_index", "file_index", "from_timestamp")
        self.places = [f"videos/{name}/{place}" for place in places if self.table is None]
        self.path, self.time = Path(), 0.0

    def episodes(self) -> Iterator[dict[str, Any]]:
        """Yield what is said of each episode."""
        table = open_table(self.folder / EPISODES)
        columns = ["episode_index", "tasks", "length", *self.places]
        columns += [TRUNCATED] * (TRUNCATED in table.schema.names)
        for batch in table.to_batches(columns=columns):
            yield from batch.to_pylist()

    def frames(self, row: dict[str, Any], steps: range) -> Iterator[tuple[str, Source]]:
        """Yield some frames of an episode, each with its name."""
        if self.table is None:
            chunk, file, start = (row[place] for place in self.places)
            path = VIDEO.format(video_key=self.name, chunk_index=chunk, file_index=file)
            shown = (self._at(self.folder / path, start + step / self.fps) for step in steps)
        else:
            here = optional("pyarrow.dataset", "datasets").field("episode_index")
            chosen = {"columns": [self.name, "frame_index"], "filter": here == row["episode_index"]}
            pictures = read_episode(self.table, **chosen).sort_by("frame_index")[self.name]
            shown = (pictures[step].as_py()["bytes"] for step in steps)
        yield from ((f"frame {step}", image) for step, image in zip(steps, shown, strict=True))

    def _at(self, path: Path, time: float) -> Image.Image:
        """Return what a video shows at a time; one that is open goes on where it can."""
        half = 0.5 / self.fps
        if path != self.path or time <= self.time + half:
            self.path, self.video = path, read_video(path)
        for image in self.video:
            self.time = image.info["time"]
            if abs(self.time - time) <= half:
                return image
            if self.time > time:
                break
        raise UserError(f"{path} shows nothing at {time:.3f} s")


def save_lerobot(demos: Demonstrations, folder: str | Path) -> None:
    """Write demonstrations as a folder of LeRobot's format v3: pictures without loss, no actions.

    Args:
        demos: with a vocabulary.
        folder: where to, a new or an empty one; it appears when everything is written.

    Raises:
        UserError: as of :func:`~ifo_grounding.data.save_pictures`, or where pyarrow is missing.
    """
    arrow, parquet, pandas = (
        optional(name, extra="datasets") for name in ("pyarrow", "pyarrow.parquet", "pandas")
    )
    sentences, lengths = written_sentences(demos), demos.lengths
    tasks, ends = sorted(set(sentences)), lengths.cumsum(0)
    said = {"timestamp": "float32", **dict.fromkeys(NUMBERS, "int64")}
    stored = arrow.struct({"bytes": arrow.binary(), "path": arrow.string()})
    schema = arrow.schema([*said.items(), (CAMERA, stored)])
    with atomic_write(new_folder(folder)) as temporary:
        files = [temporary / f"{name}/chunk-000/file-000.parquet" for name in ("data", EPISODES)]
        for path in files:
            path.parent.mkdir(parents=True)
        with parquet.ParquetWriter(files[0], schema) as writer:
            for number, sentence in enumerate(sentences):
                shown = [_stored(frame) for frame in rgb(demos[number]["pixels"])]
                step = np.arange(len(shown))
                index = int(ends[number] - lengths[number]) + step
                numbers = dict(
                    zip(NUMBERS, (step, number, index, tasks.index(sentence)), strict=True)
                )
                rows = {"timestamp": step / FRAMES_PER_SECOND, **numbers, CAMERA: shown}
                frame = pandas.DataFrame(rows)
                writer.write_table(arrow.Table.from_pandas(frame, schema, preserve_index=False))
        episodes: dict[str, Any] = {
            "episode_index": range(len(demos)),
            "tasks": [[said] for said in sentences],
        }
        episodes |= {"length": lengths, "dataset_from_index": ends - lengths}
        episodes |= {"dataset_to_index": ends, TRUNCATED: demos.cut}
        episodes |= {"data/chunk_index": 0, "data/file_index": 0}
        pandas.DataFrame(episodes).to_parquet(files[1], index=False)
        named = pandas.Index(tasks, name="task")
        table = pandas.DataFrame({"task_index": range(len(tasks))}, index=named)
        table.to_parquet(temporary / "meta/tasks.parquet")
        image = {"dtype": "image", "shape": [*demos.image_shape[1:], 3], "names": IMAGE}
        features = {
            name: {"dtype": kind, "shape": [1], "names": None} for name, kind in said.items()
        }
        info: dict[str, Any] = {
            "codebase_version": VERSION,
            "robot_type": None,
            "fps": FRAMES_PER_SECOND,
        }
        info |= {"total_episodes": len(demos), "total_frames": demos.n_frames}
        info |= {"total_tasks": len(tasks), "splits": {"train": f"0:{len(demos)}"}}
        info |= {"chunks_size": 1000, "data_path": f"data/{FILE}.parquet", "video_path": None}
        write_json(temporary / INFO, info | {"features": features | {CAMERA: image}})


def _stored(frame: np.ndarray) -> dict[str, Any]:
    file = BytesIO()
    Image.fromarray(frame).save(file, "PNG")
    return {"bytes": file.getvalue(), "path": None}
