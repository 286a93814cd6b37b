"""A recipe killed at any moment continues to the same result."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from safetensors.torch import load_file

from ifo_grounding.cli import recipes_folder
from ifo_grounding.files import read_json

STAGES = ["record_demonstrations", "collect_transitions", "train_inverse", "label"]
OPTIONS = [
    "budget=tiny",
    "demonstrations.n=60",
    "progress=false",
    "threads=1",
    "checkpoint_seconds=0",
    *("imitate.steps=60", "imitate.iteration=2", "imitate.batch_size=64"),
]


def start(name, run):
    command = [sys.executable, str(recipes_folder() / f"{name}.py"), f"run={run}", *OPTIONS]
    return subprocess.Popen(
        command, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL
    )


def finish(name, run):
    assert start(name, run).wait() == 0


@pytest.fixture
def prepared(tmp_path):
    for name in STAGES:
        finish(name, tmp_path / "run")
    return tmp_path / "run"


def last_saved(run) -> int:
    """Return when a checkpoint of the imitation was written last, 0 where none was."""
    found = (run / "checkpoints").glob("imitate/*.pt")
    return max((path.stat().st_mtime_ns for path in found), default=0)


def test_sigkill_changes_nothing(prepared, tmp_path):
    whole = tmp_path / "whole"
    shutil.copytree(prepared, whole)
    finish("imitate", whole)
    draw = random.Random(0)
    killed = 0
    for _ in range(3):
        process = start("imitate", prepared)
        deadline = time.monotonic() + 120
        before = last_saved(prepared)
        while process.poll() is None and time.monotonic() < deadline:
            if last_saved(prepared) != before:
                time.sleep(draw.uniform(0, 0.3))
                break
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        killed += process.wait() == -signal.SIGKILL
    assert killed
    finish("imitate", prepared)
    name = "policy-phase1.safetensors"
    weights, expected = load_file(prepared / name), load_file(whole / name)
    assert weights.keys() == expected.keys()
    assert all(torch.equal(weight, expected[key]) for key, weight in weights.items())
    results = [read_json(run / "stages" / "imitate.json")["result"] for run in (prepared, whole)]
    for result in results:
        result.pop("samples_per_second")
    assert results[0] == results[1]
