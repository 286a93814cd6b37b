"""A recipe killed at any moment continues to the same result."""

import multiprocessing
import shutil
import signal
import time

import torch
from safetensors.torch import load_file

from ifo_grounding.files import read_json
from recipes.conftest import make_stages

FORK = multiprocessing.get_context("fork")
OPTIONS = ("imitate.steps=60", "imitate.iteration=2", "checkpoint_seconds=0")


def last_saved(run) -> int:
    """Return when a checkpoint of the imitation was written last, 0 where none was."""
    found = (run / "checkpoints").glob("imitate/*.pt")
    return max((path.stat().st_mtime_ns for path in found), default=0)


def test_sigkill_changes_nothing(options, tmp_path):
    from imitate import imitate

    make_stages(options(*OPTIONS, run="prepared"), until="label")
    whole, killed = tmp_path / "whole", tmp_path / "run"
    for run in (whole, killed):  # this process holds the lock of what it has opened
        shutil.copytree(tmp_path / "prepared", run)
    imitate(options(*OPTIONS, run="whole"))
    kills = 0
    for pause in (0.02, 0.2):
        child = FORK.Process(target=imitate, args=(options(*OPTIONS),))
        child.start()
        deadline, before = time.monotonic() + 120, last_saved(killed)
        while child.is_alive() and time.monotonic() < deadline and last_saved(killed) == before:
            time.sleep(0.01)
        time.sleep(pause)
        child.kill()
        child.join()
        kills += child.exitcode == -signal.SIGKILL
    assert kills
    imitate(options(*OPTIONS))
    name = "policy-phase1.safetensors"
    weights, expected = load_file(killed / name), load_file(whole / name)
    assert weights.keys() == expected.keys()
    assert all(torch.equal(weight, expected[key]) for key, weight in weights.items())
    results = [read_json(run / "stages" / "imitate.json")["result"] for run in (killed, whole)]
    litter = [path for path in killed.rglob(".*.*") if path.suffix in (".tmp", ".old")]
    assert not litter
    for result in results:
        result.pop("samples_per_second")
    assert results[0] == results[1]
