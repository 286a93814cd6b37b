"""Processes that learn together do what one process does with all of a batch."""

import os
import shutil
import subprocess
import sys

import pytest
import torch
from safetensors.torch import load_file

from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json
from ifo_grounding.training import parallel
from recipes.conftest import TINY, make_stages
from training.tiny import labelled

PAPER = ("preset=paper", "networks.dropout=0", "imitate.steps=60", "imitate.iteration=10")


def test_processes_take_equal_shares_of_the_batches_of_one(monkeypatch):
    buffer = labelled(1)
    (whole,) = parallel.samples(buffer, 12, 1, seed=3)
    monkeypatch.setattr(parallel, "processes", lambda: 3)
    parts = []
    for number in range(3):
        monkeypatch.setattr(parallel, "rank", lambda number=number: number)
        parts += parallel.samples(buffer, 12, 1, seed=3)
    together = torch.stack([part["pixels"] for part in parts], 1).flatten(0, 1)
    assert torch.equal(together, whole["pixels"])
    with pytest.raises(UserError, match="batch_size=13 samples are no 3 equal shares"):
        [*parallel.samples(buffer, 13, 1, seed=3)]


@pytest.mark.slow
def test_two_processes_learn_the_curve_of_one(options, tmp_path):
    from imitate import imitate

    make_stages(options(*PAPER, run="prepared"), until="label")
    for run in ("one", "two"):
        shutil.copytree(tmp_path / "prepared", tmp_path / run)
    imitate(options(*PAPER, run="one"))
    command = [
        *(sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"),
        *("-m", "ifo_grounding", "run", "imitate", *TINY, *PAPER, f"run={tmp_path / 'two'}"),
    ]
    ended = subprocess.run(
        command, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=True, text=True, stdout=-1
    )
    assert ended.stdout.count("imitate: running") == 1
    curves = [
        [row["loss_imitation"] for row in read_json(tmp_path / run / "metrics/imitate.json")]
        for run in ("one", "two")
    ]
    assert len(curves[0]) == 6 and curves[0][-1] < 0.97 * curves[0][0]
    assert curves[1] == pytest.approx(curves[0], rel=1e-3)
    weights = [load_file(tmp_path / run / "policy-phase1.safetensors") for run in ("one", "two")]
    for name, weight in weights[0].items():
        torch.testing.assert_close(weights[1][name], weight, rtol=0, atol=2e-3)
