"""A recipe killed at any moment continues to the same result."""

import os
import shutil
import signal
import subprocess
import sys
import time

import torch
from safetensors.torch import load_file

from ifo_grounding.files import read_json
from recipes.conftest import TINY, make_stages

OPTIONS = ("imitate.steps=60", "imitate.iteration=2", "checkpoint_seconds=0")


def last_saved(run) -> int:
    """Return when a checkpoint of the imitation was written last, 0 where none was."""
    found = (run / "checkpoints").glob("imitate/*.pt")
    return max((path.stat().st_mtime_ns for path in found), default=0)


def test_sigkill_changes_nothing(options, recipes, tmp_path):
    from imitate import imitate

    make_stages(options(*OPTIONS, run="prepared"), until="label")
    whole, killed = tmp_path / "whole", tmp_path / "run"
    for run in (whole, killed):  # this process holds the lock of what it has opened
        shutil.copytree(tmp_path / "prepared", run)
    imitate(options(*OPTIONS, run="whole"))
    command = [sys.executable, str(recipes / "imitate.py"), *TINY, *OPTIONS, f"run={killed}"]
    kills = 0
    for pause in (0.02, 0.2):
        process = subprocess.Popen(
            command, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL
        )
        deadline, before = time.monotonic() + 120, last_saved(killed)
        while process.poll() is None and time.monotonic() < deadline:
            if last_saved(killed) != before:
                time.sleep(pause)
                break
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        kills += process.wait() == -signal.SIGKILL
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
