"""How many cores there are."""

import os

import pytest

from ifo_grounding import machine
from ifo_grounding.worlds import BabyAI


def test_cores_are_those_of_the_process(tmp_path, monkeypatch):
    (tmp_path / "cpu.max").write_text("300000 100000")
    monkeypatch.setattr(machine, "QUOTA", tmp_path / "cpu.max")
    for allowed, expected in ((range(8), 3), ([5], 1)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=allowed: {*cores})
        assert machine.cores() == expected
        pytest.importorskip("minigrid")
        assert BabyAI("GoToObj")._processes == expected
