"""Files that are there as a whole or not at all."""

import math
import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from ifo_grounding.errors import UserError
from ifo_grounding.files import atomic_write, read_json, write_json


def test_what_is_not_finite_becomes_null(tmp_path):
    write_json(tmp_path / "file", {"b": [math.nan, 1.5], "a": (math.inf, True), "c": "nan"})
    assert read_json(tmp_path / "file") == {"a": [None, True], "b": [None, 1.5], "c": "nan"}


def make_folder(path, then=lambda: None):
    with atomic_write(path) as temporary:
        temporary.mkdir()
        then()


@pytest.mark.parametrize("moves", [0, 1])
def test_an_interrupted_replacement_leaves_the_old_folder(tmp_path, monkeypatch, moves):
    folder = tmp_path / "kept"
    folder.mkdir()
    (folder / "old").touch()
    replace, done = os.replace, []

    def interrupted(source, target):
        if len(done) == moves:
            done.append(None)
            raise KeyboardInterrupt
        done.append(replace(source, target))

    with pytest.raises(KeyboardInterrupt):
        make_folder(folder, lambda: monkeypatch.setattr(os, "replace", interrupted))
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    assert (folder / "old").exists()


def test_a_folder_does_not_take_the_place_of_a_file(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(NotADirectoryError):
        make_folder(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_of_several_writers_of_a_folder_one_stays_and_nothing_is_left_behind(tmp_path):
    def write(writer):
        for number in range(40):
            with atomic_write(tmp_path / "shared") as temporary:
                temporary.mkdir()
                for name in "ab":
                    (temporary / name).write_text(f"{writer} {number}")

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(4)))
    assert [path.name for path in tmp_path.iterdir()] == ["shared"]
    said = {(tmp_path / "shared" / name).read_text() for name in "ab"}
    assert len(said) == 1 and said.pop().endswith("39")


SHAPES = ["[1]", "3", "null", '"result"', "{}"]


@pytest.mark.parametrize("content", ["[" * 200_000, "9" * 5_000, "{", b"\xff\xfe{", *SHAPES])
def test_what_is_no_json_or_of_another_shape_is_named(content, tmp_path):
    path = tmp_path / "meta.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UserError, match=r"meta\.json is not valid JSON"):
        read_json(path, dict, ["result"])
