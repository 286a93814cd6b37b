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


def test_threads_are_measured_anew_only_where_they_were_chosen_by_that(monkeypatch):
    found, fastest = [], iter([2, 1])
    monkeypatch.setattr(machine, "fastest_threads", lambda: next(fastest))
    monkeypatch.setattr(torch, "set_num_threads", found.append)
    clock = [0.0]
    monkeypatch.setattr(machine.time, "monotonic", lambda: clock[0])
    for threads in ("auto", 3):
        machine.choose_threads(threads)
        for seconds in (20, 20):
            clock[0] += seconds
            machine.review_threads()
    assert found == [2, 1, 3]  # not yet after 20 s, one busy core later, and a number as it is


def test_cores_are_those_of_the_process(tmp_path, monkeypatch):
    (tmp_path / "cpu.max").write_text("300000 100000")
    monkeypatch.setattr(machine, "QUOTA", tmp_path / "cpu.max")
    for allowed, expected in ((range(8), 3), ([5], 1)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=allowed: {*cores})
        assert machine.cores() == expected
        pytest.importorskip("minigrid")
        assert BabyAI("GoToObj")._processes == expected
