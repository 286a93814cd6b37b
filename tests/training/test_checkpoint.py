import errno

import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.training import Checkpoint

SETTINGS = {"lr": 0.1, "seed": 0}


@pytest.fixture
def layer():
    return torch.nn.Linear(3, 2)


@pytest.fixture
def path(tmp_path, layer):
    """A checkpoint of a layer."""
    Checkpoint(tmp_path / "run.pt", SETTINGS, layer=layer).save({})
    return tmp_path / "run.pt"


def test_a_checkpoint_of_something_else_says_of_what(path, layer):
    with pytest.raises(UserError, match=r"made with lr=0\.1, not 0\.2"):
        Checkpoint(path, {**SETTINGS, "lr": 0.2}, layer=layer).load()
    with pytest.raises(UserError, match="holds layer, here there is layer, value"):
        Checkpoint(path, SETTINGS, layer=layer, value=layer).load()
    with pytest.raises(UserError, match="holds another layer than this run has") as error:
        Checkpoint(path, SETTINGS, layer=torch.nn.Linear(2, 2)).load()
    assert "\n" not in str(error.value)


def test_a_foreign_file_is_refused_and_runs_no_code(tmp_path, layer):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    path = tmp_path / "run.pt"
    damaged = r"run\.pt is damaged.*: delete it to start over"
    for content, error in (({"weights": torch.zeros(1)}, "no checkpoint of"), (Trap(), damaged)):
        torch.save(content, path)
        with pytest.raises(UserError, match=error):
            Checkpoint(path, SETTINGS, layer=layer).load()
    assert not (tmp_path / "sprung").exists()


def test_a_full_disk_is_one_line_and_keeps_the_checkpoint_before(path, layer, monkeypatch):
    full = OSError(errno.ENOSPC, "No space left on device")
    before = path.read_bytes()
    for error in (full, RuntimeError("PytorchStreamWriter failed writing file\nat line 1")):

        def save(content, file, error=error):
            file.write_bytes(b"half of it")
            raise error

        monkeypatch.setattr(torch, "save", save)
        with pytest.raises(UserError, match=r"run\.pt cannot be written .* MB are free") as said:
            Checkpoint(path, SETTINGS, layer=layer).save({})
        assert "\n" not in str(said.value)
    assert path.read_bytes() == before and len(list(path.parent.iterdir())) == 1
