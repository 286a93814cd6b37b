import struct
import zlib

import datasets
import numpy as np
import pytest
import torch
from PIL import Image

from comparing import all_frames, assert_same
from ifo_grounding.data import (
    Demonstrations,
    from_huggingface,
    record_demonstrations,
    to_huggingface,
)
from ifo_grounding.errors import UserError
from ifo_grounding.tasks import VOCABULARY

datasets.disable_progress_bars()


def test_a_dataset_comes_back_as_it_was(demos, tmp_path):
    dataset = to_huggingface(demos, cache_dir=tmp_path / "cache")
    assert dataset[3]["instruction"] == demos.sentences()[3]
    assert dataset[3]["frames"][0].size == (48, 48)
    back = from_huggingface(dataset, vocabulary=VOCABULARY)
    assert_same(back, demos)
    assert torch.equal(back.tokens, demos.tokens)
    other = record_demonstrations("move", 3, seed=1)
    assert_same(from_huggingface(to_huggingface(other, cache_dir=tmp_path / "cache")), other)


def test_files_and_streams_are_read(demos, tmp_path):
    cache = str(tmp_path / "cache")
    dataset = to_huggingface(demos, cache_dir=cache)
    dataset.save_to_disk(tmp_path / "disk")
    dataset.to_parquet(tmp_path / "episodes.parquet")
    files = {"data_files": str(tmp_path / "episodes.parquet"), "split": "train"}
    for read in (
        datasets.load_from_disk(tmp_path / "disk"),
        datasets.Dataset.from_parquet(str(tmp_path / "episodes.parquet"), cache_dir=cache),
        datasets.load_dataset("parquet", streaming=True, cache_dir=cache, **files),
        dataset.to_iterable_dataset(),
        dataset.with_format("numpy"),
        dataset.cast_column("frames", datasets.Sequence(datasets.Image(decode=False))),
        (dict(row) for row in dataset),
    ):
        assert_same(from_huggingface(read), demos)


def test_only_the_two_columns_are_read(demos, tmp_path):
    dataset = to_huggingface(demos, cache_dir=tmp_path / "cache")
    dataset = dataset.rename_columns({"frames": "video", "instruction": "task"})
    broken = [{"bytes": b"no picture", "path": None}] * len(dataset)
    dataset = dataset.add_column("action", broken).cast_column("action", datasets.Image())
    with pytest.raises(OSError, match="identify"):
        dataset[0]
    assert_same(from_huggingface(dataset, frames="video", instruction="task"), demos)


ARRAY = np.arange(2 * 3 * 16 * 24, dtype=np.uint8).reshape(2, 3, 16, 24)


def test_arrays_and_grey_pictures_are_read():
    demos = from_huggingface([{"frames": ARRAY, "instruction": "go"}], close=False)
    assert np.array_equal(all_frames(demos), ARRAY)
    grey = [Image.fromarray(frame[0]) for frame in ARRAY]
    demos = from_huggingface([{"frames": grey, "instruction": "go"}])
    assert demos.image_shape == (3, 16, 24)
    assert np.array_equal(all_frames(demos)[:2, 1], ARRAY[:, 0])


@pytest.mark.parametrize(
    "feature",
    [
        datasets.Array4D((None, 3, 16, 24), "uint8"),
        datasets.List(datasets.Array3D((3, 16, 24), "uint8")),
        datasets.List(datasets.List(datasets.List(datasets.List(datasets.Value("uint8"))))),
    ],
)
def test_columns_of_arrays_stay_bytes(feature):
    features = datasets.Features({"frames": feature, "instruction": datasets.Value("string")})
    rows = [{"frames": ARRAY, "instruction": "go"}, {"frames": ARRAY[::-1], "instruction": "up"}]
    dataset = datasets.Dataset.from_list(rows, features=features)
    for read in (dataset, dataset.to_iterable_dataset()):
        demos = from_huggingface(read, close=False)
        assert np.array_equal(all_frames(demos), np.concatenate([ARRAY, ARRAY[::-1]]))
        assert demos.sentences() == ["go", "up"]
    rows[1]["frames"] = None
    with pytest.raises(UserError, match="episode 1 has no frames"):
        from_huggingface(datasets.Dataset.from_list(rows, features=features))


GOOD = {"frames": [Image.new("RGB", (24, 16), c) for c in ("red", "blue")], "instruction": "go"}


def second(*frames):
    return [GOOD, {"frames": [*frames], "instruction": "go"}]


@pytest.mark.parametrize(
    ("dataset", "said"),
    [
        ({"train": [GOOD], "test": [GOOD]}, r"one of the splits: .* with 'train', 'test'"),
        ([], "there is no episode"),
        ("mine/boxes", "'mine/boxes' is a str: give the dataset itself"),
        ([GOOD | {"frames": np.full((2, 3, 16, 24), 300)}], r"episode 0 is torch\.int64"),
        ([GOOD, {"frames": GOOD["frames"]}], "episode 1 has no instruction"),
        ([GOOD, GOOD | {"frames": None}], "episode 1 has no frames"),
        ([GOOD, 3], "episode 1 has no frames and no instruction"),
        (3, "3 is a int: give the dataset itself"),
        ([GOOD | {"frames": "a.mp4"}], "episode 0: it names a file, 'a.mp4', as load_pictures"),
        (second("a.png"), "episode 1: it names a file, 'a.png'"),
        (
            datasets.Dataset.from_dict(
                {"frames": ["a.mp4"], "instruction": ["go"]},
                datasets.Features(frames=datasets.Video(), instruction=datasets.Value("string")),
            ),
            r"'frames' is a column of videos, .* for load_pictures \(with the extra video\)",
        ),
        (second(), "episode 1 is .* at least one frame"),
        (
            second(*GOOD["frames"], Image.new("RGB", (8, 8))),
            "episode 1: frame 2 has 8x8 pixels, the first frame has 24x16",
        ),
        (second(Image.new("F", (24, 16))), "episode 1: frame 0 .* 'F'"),
        (second(GOOD["frames"][0], None), r"1: frame 1 cannot be read \(None is no picture"),
        ([GOOD | {"frames": GOOD["frames"][0]}], "episode 0 is a single picture, .*: group"),
        (datasets.Dataset.from_dict({"video": [1]}), r"'frames'.* dataset.* name them with fra"),
    ],
)
def test_what_is_wrong_is_said_with_the_number_of_the_row(dataset, said):
    with pytest.raises(UserError, match=said):
        from_huggingface(dataset)


SIZE = b"IHDR" + struct.pack(">2I5B", 60_000, 60_000, 8, 2, 0, 0, 0)
BOMB = b"\x89PNG\r\n\x1a\n\0\0\0\r" + SIZE + struct.pack(">2I4s4x", zlib.crc32(SIZE), 0, b"IDAT")


@pytest.mark.parametrize(
    ("content", "path", "said"),
    [
        (b"no picture", None, "identify"),
        (None, None, "None is no picture"),
        (None, "http://127.0.0.1:9/a.png", "no regular file"),
        (None, "zip://a.png::b.zip", "no regular file"),
        (BOMB, None, "exceeds limit"),
    ],
)
def test_a_stored_picture_is_opened_by_this_library_alone(content, path, said):
    rows = [GOOD, GOOD, GOOD | {"frames": [{"bytes": content, "path": path}] * 2}]
    columns = datasets.Sequence(datasets.Image()), datasets.Value("string")
    features = datasets.Features(dict(zip(GOOD, columns, strict=True)))
    with pytest.raises(UserError, match=f"^episode 2: frame 0 cannot be read .*{said}"):
        from_huggingface(datasets.Dataset.from_list(rows, features=features))


def test_demonstrations_that_are_no_pictures_are_refused():
    frames = torch.zeros(2, 2, 16, 24, dtype=torch.uint8)
    with pytest.raises(UserError, match="number of channels 2"):
        to_huggingface(Demonstrations.from_arrays([frames], ["go"]))
    with pytest.raises(UserError, match="without a vocabulary"):
        to_huggingface(Demonstrations.from_arrays([frames[:, :1]], torch.ones(1, 1).long()))
