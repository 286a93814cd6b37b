import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.training import Checkpoint, FitConfig, fingerprint
from ifo_grounding.training.checkpoint import spent


@pytest.fixture
def layer():
    return torch.nn.Linear(3, 2)


def test_a_checkpoint_restores_every_part_and_the_progress(tmp_path, layer):
    optimizer = torch.optim.Adam(layer.parameters())
    layer(torch.ones(3)).sum().backward()
    optimizer.step()
    path = tmp_path / "run.pt"
    Checkpoint(path, "same", layer=layer, optimizer=optimizer).save({"iteration": 7})

    other = torch.nn.Linear(3, 2)
    fresh = torch.optim.Adam(other.parameters())
    progress = Checkpoint(path, "same", layer=other, optimizer=fresh).load()

    assert progress == {"iteration": 7}
    assert torch.equal(other.weight, layer.weight)
    moments = [state["exp_avg"] for state in fresh.state_dict()["state"].values()]
    assert all(moment.abs().sum() > 0 for moment in moments)


def test_without_a_file_there_is_nothing_to_continue_from(tmp_path, layer):
    assert Checkpoint(tmp_path / "none.pt", "a", layer=layer).load() is None


def test_a_checkpoint_of_other_settings_is_refused(tmp_path, layer):
    path = tmp_path / "run.pt"
    Checkpoint(path, "one", layer=layer).save({})
    with pytest.raises(UserError, match="other settings"):
        Checkpoint(path, "two", layer=layer).load()


def test_a_checkpoint_of_other_parts_is_refused(tmp_path, layer):
    path = tmp_path / "run.pt"
    Checkpoint(path, "a", layer=layer).save({})
    with pytest.raises(UserError, match="holds layer, here there is guard, layer"):
        Checkpoint(path, "a", layer=layer, guard=layer).load()
    with pytest.raises(UserError, match="holds another layer than this run has"):
        Checkpoint(path, "a", layer=torch.nn.Linear(2, 2)).load()


def test_time_is_counted_from_before_an_interruption(tmp_path, layer, monkeypatch):
    path, clock = tmp_path / "run.pt", [100.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    checkpoint = Checkpoint(path, "a", layer=layer)
    clock[0] = 107.0
    checkpoint.save({})
    clock[0] = 500.0
    resumed = Checkpoint(path, "a", layer=layer)
    resumed.load()
    clock[0] = 503.0
    resumed.save({})
    assert spent(path) == 10.0
    assert spent(tmp_path / "none.pt") == 0.0


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", None])
def test_a_damaged_checkpoint_is_named(tmp_path, layer, content):
    path = tmp_path / "run.pt"
    Checkpoint(path, "a", layer=layer).save({})
    path.write_bytes(path.read_bytes()[:200] if content is None else content)
    with pytest.raises(UserError, match=r"run\.pt is damaged"):
        Checkpoint(path, "a", layer=layer).load()


def test_a_foreign_file_is_refused(tmp_path, layer):
    path = tmp_path / "run.pt"
    torch.save({"weights": torch.zeros(1)}, path)
    with pytest.raises(UserError, match="no checkpoint of this library"):
        Checkpoint(path, "a", layer=layer).load()


def test_pickled_code_never_runs(tmp_path, layer):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    path = tmp_path / "run.pt"
    torch.save({"format": Trap()}, path)
    with pytest.raises(UserError, match="damaged"):
        Checkpoint(path, "a", layer=layer).load()
    assert not (tmp_path / "sprung").exists()


def test_fingerprints_tell_settings_apart():
    assert fingerprint(FitConfig(steps=3)) == fingerprint(FitConfig(steps=3))
    assert fingerprint(FitConfig(steps=3)) != fingerprint(FitConfig(steps=4))
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})


def test_delete_is_safe_to_repeat(tmp_path, layer):
    checkpoint = Checkpoint(tmp_path / "run.pt", "a", layer=layer)
    checkpoint.save({})
    checkpoint.delete()
    checkpoint.delete()
    assert checkpoint.load() is None
