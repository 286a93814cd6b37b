"""Demonstrations from and to Minari datasets, whose actions are never read."""

from __future__ import annotations

import contextlib
import functools
import math
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from ifo_grounding.channels import channels_first
from ifo_grounding.data._episodes import Episode, check_size, open_table, read_table
from ifo_grounding.data._images import stack_images
from ifo_grounding.data.demonstrations import Demonstrations
from ifo_grounding.data.folder import DAMAGED
from ifo_grounding.data.pictures import rgb, written_sentences
from ifo_grounding.errors import UserError, optional
from ifo_grounding.files import atomic_write, read_json, regular_file
from ifo_grounding.progress import progress_bar

if TYPE_CHECKING:
    from minari import MinariDataset

IMAGE, INSTRUCTION = "image", "mission"
OBSERVED = "observations"
ENDS = ("truncations", "terminations")
"""Names of what says how an episode ended."""
DESCRIPTION = (
    "Observation-only demonstrations: actions and rewards are absent. The format demands them, so "
    "both are 0 throughout and mean nothing."
)

Read = Callable[[int, str, str | None], Any]
"""Returns what an episode holds below a name, such as its observations, or one part of it."""


def from_minari(
    dataset: MinariDataset | str,
    *,
    image: str | None = IMAGE,
    instruction: str = INSTRUCTION,
    progress: bool = False,
    **options: Any,
) -> Demonstrations:
    """Read the images and instructions of a Minari dataset, episode by episode.

    Its actions and rewards are never read, not even from disk: a dataset that has them gives the
    same demonstrations as one that has none. An episode that was truncated, and not terminated,
    stays open: its last frame is no stop.

    Args:
        dataset: a dataset or a part of one, or the id of one on this machine.
        image: name of the image in the observation; None where the observation is the image.
        instruction: name of the sentence in the observation, where it is the same throughout an
            episode, or else in the metadata of the episode or of the dataset.
        options: for :meth:`Demonstrations.from_episodes`.

    Raises:
        UserError: where Minari or the dataset is missing, the names are not those of the dataset,
            or an episode is not as it has to be, with its number.
    """
    minari = optional("minari", extra="minari")
    if isinstance(dataset, str):
        dataset = _local(minari, dataset)
    if not isinstance(dataset, minari.MinariDataset):
        raise UserError(f"{dataset!r:.40} is no dataset of Minari: give one, or its id")
    with _opened(dataset) as read:
        episodes = _episodes(dataset, read, image, instruction, progress)
        return Demonstrations.from_episodes(episodes, **options)


def _local(minari: Any, dataset_id: str) -> MinariDataset:
    """Return the dataset of an id that lies on this machine."""
    from minari.storage.datasets_root_dir import get_dataset_path

    folder = get_dataset_path(dataset_id) / "data"
    if not folder.is_dir():
        raise UserError(
            f"there is no dataset {dataset_id!r} on this machine ({folder}): fetch it with "
            f"'minari download {dataset_id}', or check its name with 'minari list local'"
        )
    try:
        if (count := read_json(folder / "metadata.json")["total_episodes"]) > 10**7:
            raise ValueError(f"it claims {count} episodes")
        return minari.load_dataset(dataset_id)
    except Exception as error:  # damaged metadata ends in many ways
        raise UserError(f"{folder} cannot be read ({error})") from None


def _episodes(
    dataset: MinariDataset, read: Read, image: str | None, instruction: str, progress: bool
) -> Iterator[Episode]:
    space, storage = dataset.observation_space, dataset.storage
    common = storage.metadata
    known = dict(space.spaces) if isinstance(space, spaces.Dict) else {}
    shown = space if image is None else known.get(image)
    if not isinstance(shown, spaces.Box):
        raise UserError(
            f"there is no image {image!r} in the observation ({sorted(known) or 'one array'}): "
            "name it with image=..., or image=None where the observation is the image"
        )
    for number in progress_bar(dataset.episode_indices.tolist(), desc="read", shown=progress):
        try:
            frames = _decoded(read(number, OBSERVED, image), shown, storage.jpeg_encoding)
            truncated, terminated = (np.any(read(number, name, None)) for name in ENDS)
            if instruction in known:
                said = {_text(text) for text in read(number, OBSERVED, instruction)}
            else:
                facts = common | next(iter(storage.get_episode_metadata([number])))
                said = {_text(facts[instruction])} if instruction in facts else set()
        except (OSError, *DAMAGED) as error:
            raise UserError(f"episode {number} cannot be read ({error})") from None
        if not said:
            raise UserError(
                f"there is no instruction {instruction!r} in the observation ({sorted(known)}) or "
                f"the metadata of episode {number}: name it with instruction=..."
            )
        if len(said) > 1:
            raise UserError(
                f"episode {number} has {len(said)} instructions: a demonstration follows one"
            )
        yield number, frames, said.pop(), bool(truncated and not terminated)


def _text(value: Any) -> str:
    if not isinstance(value, str | bytes):
        raise TypeError(f"an instruction is text, got {type(value).__name__} {value!r:.40}")
    return value.decode() if isinstance(value, bytes) else str(value)


def _decoded(rows: Any, space: spaces.Box, jpeg: bool) -> np.ndarray:
    """Return images as before storing, [T + 1, C, H, W]; what is no image stays as it is."""
    from minari.dataset.minari_storage import is_image_space

    if jpeg and is_image_space(space):
        named = ((f"image {at}", bytes(row)) for at, row in enumerate(rows))
        return stack_images(named, (*space.shape, 1)[2])
    frames = np.stack(rows).reshape(-1, *space.shape)
    return channels_first(frames) if frames.ndim > 2 else frames


@contextlib.contextmanager
def _opened(dataset: MinariDataset) -> Iterator[Read]:
    """Open the observations of a dataset and nothing else: Minari itself reads actions along."""
    folder, kind = Path(dataset.storage.data_path), dataset.storage.FORMAT
    if kind != "hdf5":
        yield functools.partial(_read_table, folder, kind)
        return
    import h5py

    try:
        file = h5py.File(regular_file(folder / "main_data.hdf5"), "r")
    except OSError as error:
        raise UserError(f"{folder} cannot be read ({error})") from None
    with file:
        yield functools.partial(_read_group, file)


def _read_group(file: Any, number: int, name: str, part: str | None) -> Any:
    """Return an array that lies in this very file: links and storage in others are refused."""
    import h5py

    found = file
    for step in filter(None, (f"episode_{number}", name, part)):
        if name in ENDS and step not in found:
            return ()  # nobody says how the episode ended
        if not isinstance(found.get(step, getlink=True), h5py.HardLink | None):
            raise OSError(f"{step!r} is a link")
        found = found[step]
    if found.external or found.is_virtual:
        raise OSError(f"{found.name!r} lies in another file")
    check_size(math.prod(found.shape[:1]), found.nbytes)
    return found[()]


def _read_table(folder: Path, kind: str, number: int, name: str, part: str | None) -> Any:
    from pyarrow.dataset import field

    ignored = ["_", ".", "metadata.json"]
    table = open_table(folder / str(number), kind, ignore_prefixes=ignored)
    if name in ENDS and name not in table.schema.names:
        return ()
    column = field(name) if part is None else field(name, part)
    return read_table(table, columns={"rows": column})["rows"].to_numpy()


def to_minari(demos: Demonstrations, dataset_id: str, **details: Any) -> MinariDataset:
    """Write demonstrations as a Minari dataset, with a placeholder instead of actions.

    An observation holds ``image``, uint8 [H, W, 3] without loss, and ``mission``, the instruction.
    The format demands actions and rewards. Their place is taken by zeros: the action space has a
    single value, and the dataset's metadata says ``actions_absent``.

    Args:
        dataset_id: such as ``"mine/boxes-v0"``, below ``$MINARI_DATASETS_PATH``; it appears when
            everything is written.
        details: for ``minari.create_dataset_from_buffers``, such as ``author``.

    Raises:
        UserError: where Minari is missing, the id is none or taken, there is no demonstration or
            no vocabulary, or frames are no pictures.
    """
    minari = optional("minari", extra="minari")
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.dataset.minari_storage import MinariStorage
    from minari.storage.datasets_root_dir import get_dataset_path

    sentences = written_sentences(demos)
    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError):  # the latter where the version is missing
        raise UserError(
            f"{dataset_id!r} is no id of a dataset: it has to be such as 'boxes-v0' or "
            "'mine/boxes-v0', of letters, digits, - and _"
        ) from None
    folder = get_dataset_path(dataset_id)
    if folder.exists():
        raise UserError(f"the dataset {dataset_id!r} exists: choose another name or version")
    _, height, width = demos.image_shape
    characters = "".join(sorted(set("".join(sentences))))
    observation = {
        IMAGE: spaces.Box(0, 255, (height, width, 3), np.uint8),
        INSTRUCTION: spaces.Text(max(map(len, sentences)), charset=characters),
    }

    def buffers() -> Iterator[EpisodeBuffer]:
        for number, (sentence, cut) in enumerate(zip(sentences, demos.cut.tolist(), strict=True)):
            frames = rgb(demos[number]["pixels"])
            steps = len(frames) - 1
            last = np.arange(steps) == steps - 1
            yield EpisodeBuffer(
                observations={IMAGE: frames, INSTRUCTION: [sentence] * len(frames)},
                actions=np.zeros(steps, np.int64),
                rewards=np.zeros(steps),
                terminations=last & (not cut),
                truncations=last & cut,
            )

    try:
        with atomic_write(folder) as unfinished, warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*None", UserWarning)  # of details left out
            try:
                minari.create_dataset_from_buffers(
                    dataset_id,
                    [],
                    observation_space=spaces.Dict(observation),
                    action_space=spaces.Discrete(1),
                    jpeg_encoding=False,
                    **{"description": DESCRIPTION, **details},
                )
            finally:  # a dotted folder, which Minari does not list and which goes if this fails
                if folder.exists():
                    folder.rename(unfinished)
            storage = MinariStorage.read(unfinished / "data")
            storage.update_episodes(buffers())
            storage.update_metadata({"actions_absent": True})
    except (ValueError, AssertionError) as error:  # a detail that Minari does not take, for one
        raise UserError(f"{dataset_id!r} cannot be written: {error}") from None
    return minari.load_dataset(dataset_id)
