"""Files that are there as a whole or not at all."""

import json
import math
import os

import pytest

from ifo_grounding.files import atomic_write, write_json


def test_what_is_not_finite_becomes_null(tmp_path):
    write_json(tmp_path / "file", {"b": [math.nan, 1.5], "a": (math.inf, True), "c": "nan"})
    assert json.loads((tmp_path / "file").read_text()) == {
        "a": [None, True],
        "b": [None, 1.5],
        "c": "nan",
    }


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

    def write():
        with atomic_write(folder) as temporary:
            temporary.mkdir()
            monkeypatch.setattr(os, "replace", interrupted)

    with pytest.raises(KeyboardInterrupt):
        write()
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    assert (folder / "old").exists()
