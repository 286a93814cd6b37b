"""How many threads a stage begins with."""

import os

import pytest
import torch

from ifo_grounding import machine
from ifo_grounding.worlds import BabyAI


@pytest.mark.parametrize(
    ("several", "quota", "chosen"),
    [(0.5, "max 100000", 4), (0.95, "max 100000", 1), (0.5, "200000 100000", 2)],
)
def test_several_threads_have_to_pay(tmp_path, monkeypatch, several, quota, chosen):
    clock, tick = [0.0], [1.0]

    def now():
        clock[0] += tick[0]
        return clock[0]

    (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(machine, "QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(machine, "MOST_THREADS", 4)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {*range(8)})
    monkeypatch.setattr(machine.time, "perf_counter", now)
    set_threads = {1: 1.0, 2: several, 4: several}.get
    monkeypatch.setattr(torch, "set_num_threads", lambda n: tick.insert(0, set_threads(n)))
    assert machine.fastest_threads() == chosen


def test_cores_are_those_of_the_process(tmp_path, monkeypatch):
    (tmp_path / "cpu.max").write_text("300000 100000")
    monkeypatch.setattr(machine, "QUOTA", tmp_path / "cpu.max")
    for allowed, expected in ((range(8), 3), ([5], 1)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=allowed: {*cores})
        assert machine.cores() == expected
        pytest.importorskip("minigrid")
        assert BabyAI("GoToObj")._processes == expected
