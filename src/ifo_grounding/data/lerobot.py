"""Demonstrations from and to folders of LeRobot's format v3: without its package or its actions."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ifo_grounding.data._episodes import Episode, naming, open_table, read_table
from ifo_grounding.data._images import Source, stack_images
from ifo_grounding.data._video import read_video
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.folder import DAMAGED, vacant
from ifo_grounding.data.pictures import FRAMES_PER_SECOND, TRUNCATED, rgb, written_sentences
from ifo_grounding.errors import UserError, at_least_one, optional
from ifo_grounding.files import atomic_write, read_json, write_json
from ifo_grounding.progress import progress_bar

INFO, VERSION = "meta/info.json", "v3.0"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
CAMERA = "observation.image"


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
        camera: name of the camera, where there are several.
        stride: of so many frames one is taken, counted back from the last one.
        size: height and width that frames are scaled to; by default they stay as they are.
        options: for :meth:`Demonstrations.from_episodes`.

    Raises:
        UserError: where the folder is of another format or damaged, the camera is none of its own,
            or an episode is not as it has to be, with its number.
    """
    stride = at_least_one("stride", stride)

    def episodes() -> Iterator[Episode]:
        seen = _Camera(Path(folder), camera)
        for row in progress_bar(seen.episodes(), desc="read", shown=progress):
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
    """What a camera saw, in videos that go on from episode to episode, or in tables."""

    def __init__(self, folder: Path, name: str | None) -> None:
        info = read_json(folder / INFO)
        if info["codebase_version"] != VERSION:
            raise UserError(
                f"{folder} is of LeRobot's format {info['codebase_version']}: convert it to "
                f"{VERSION} with LeRobot's tools"
            )
        kinds = {name: feature["dtype"] for name, feature in info["features"].items()}
        cameras = [name for name, kind in kinds.items() if kind in ("image", "video")]
        name = cameras[0] if name is None and len(cameras) == 1 else name
        if name not in cameras:
            raise UserError(
                f"camera={name} is none of {', '.join(map(repr, cameras))}: choose with camera=, "
                "and for a recipe's recorded= save() what you read"
            )
        self.folder, self.name, self.fps = folder, name, float(info["fps"])
        self.files = f"videos/{name}" if kinds[name] == "video" else "data"
        self.path, self.time = Path(), 0.0

    def episodes(self) -> Iterator[dict[str, Any]]:
        """Yield what is said of each episode, but for statistics."""
        table = open_table(self.folder / "meta/episodes")
        columns = [name for name in table.schema.names if not name.startswith("stats/")]
        for batch in table.to_batches(columns=columns):
            yield from batch.to_pylist()

    def frames(self, row: dict[str, Any], steps: range) -> Iterator[tuple[str, Source]]:
        """Yield some frames of an episode, each with its name."""
        where = {name: row[f"{self.files}/{name}"] for name in ("chunk_index", "file_index")}
        path = self.folder / self.files / FILE.format(**where)
        if self.files == "data":
            table = open_table(path.with_suffix(".parquet"))
            here = optional("pyarrow.dataset", "datasets").field("episode_index")
            chosen = {"columns": [self.name, "frame_index"], "filter": here == row["episode_index"]}
            found = read_table(table, **chosen).sort_by("frame_index")
            if found["frame_index"].to_pylist() != [*range(row["length"])]:
                raise UserError(f"{path} holds no frames 0 to {row['length'] - 1}, or not once")
            pictures = found[self.name]
        for step in steps:
            if self.files == "data":
                yield f"frame {step}", pictures[step].as_py()["bytes"]
            else:
                time = row[f"{self.files}/from_timestamp"] + step / self.fps
                yield f"frame {step}", self._at(path.with_suffix(".mp4"), time)

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
        folder: where to, a new or an empty one; it appears when everything is written.

    Raises:
        UserError: as of :func:`~ifo_grounding.data.save_pictures`, or where pandas is missing.
    """
    pandas = optional("pandas", extra="datasets")
    sentences, lengths, numbers = written_sentences(demos), demos.lengths, torch.arange(len(demos))
    tasks, ends = sorted(set(sentences)), lengths.cumsum(0)
    episodes = {"episode_index": numbers, "tasks": [[said] for said in sentences]}
    episodes |= {"length": lengths, "dataset_from_index": ends - lengths, "dataset_to_index": ends}
    episodes |= {"data/chunk_index": numbers // 1000, "data/file_index": numbers % 1000}
    with atomic_write(vacant(folder)) as temporary:

        def write(name: str, rows: dict[str, Any], index: Any = None) -> None:
            path = temporary / f"{name}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            pandas.DataFrame(rows, index).to_parquet(path, write_page_checksum=True)

        for number, sentence in enumerate(sentences):
            step = np.arange(int(lengths[number]))
            said = {"timestamp": (step / FRAMES_PER_SECOND).astype(np.float32), "frame_index": step}
            said |= {"episode_index": number, "index": int(ends[number]) - len(step) + step}
            said |= {"task_index": tasks.index(sentence)}
            shown = [_stored(frame) for frame in rgb(demos[number]["pixels"])]
            name = FILE.format(chunk_index=number // 1000, file_index=number % 1000)
            write(f"data/{name}", said | {CAMERA: shown})
        write("meta/episodes/chunk-000/file-000", episodes | {TRUNCATED: demos.cut})
        write("meta/tasks", {"task_index": range(len(tasks))}, tasks)
        single: Any = {"shape": [1], "names": None}
        features: Any = {name: {"dtype": "int64", **single} for name in said}
        features["timestamp"]["dtype"] = "float32"
        names, shape = ["height", "width", "channels"], [*demos.image_shape[1:], 3]
        features[CAMERA] = {"dtype": "image", "shape": shape, "names": names}
        info: Any = {"codebase_version": VERSION, "robot_type": None, "fps": FRAMES_PER_SECOND}
        info |= {"total_episodes": len(demos), "total_frames": demos.n_frames}
        info |= {"total_tasks": len(tasks), "splits": {"train": f"0:{len(demos)}"}}
        info |= {"chunks_size": 1000, "data_path": f"data/{FILE}.parquet", "video_path": None}
        write_json(temporary / INFO, info | {"features": features})


def _stored(frame: np.ndarray) -> dict[str, Any]:
    file = BytesIO()
    Image.fromarray(frame).save(file, "PNG")
    return {"bytes": file.getvalue(), "path": "frame.png"}
