"""Measuring contenders side by side: alternating repeats, medians, ratios within one run."""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PEERS = ROOT / ".venv-peers"

Once = Callable[[], tuple[float, float]]
"""Does the work of one repeat: how much was done, and in how many seconds."""


def timed(work: Callable[[], float]) -> Once:
    """Time a function that says how much it has done."""

    def once() -> tuple[float, float]:
        start = time.perf_counter()
        done = work()
        return done, time.perf_counter() - start

    return once


@dataclass
class Row:
    """One line of the table: this project first, then what it is compared with."""

    name: str
    unit: str
    contenders: dict[str, Once]
    note: str = ""
    facts: dict[str, float] = field(default_factory=dict)
    """What else was found, such as megabytes."""
    peers: list[Peer] = field(default_factory=list)

    def measure(self, repeats: int) -> dict[str, Any]:
        """Let all contenders work by turns, once without counting and then ``repeats`` times."""
        rates: dict[str, list[float]] = {name: [] for name in self.contenders}
        for repeat in range(repeats + 1):
            for name, once in self.contenders.items():
                done, seconds = once()
                if repeat:
                    rates[name].append(done / seconds)
        ours, *others = rates or [""]
        ratios = {
            name: spread([a / b for a, b in zip(rates[ours], rates[name], strict=True)])
            for name in others
        }
        memory = {ours: peak_memory(), **{peer.name: peer.memory() for peer in self.peers}}
        for peer in self.peers:
            peer.close()
        return {
            "name": self.name,
            "unit": self.unit,
            "rates": {name: spread(values) for name, values in rates.items()},
            "ratios": ratios,
            "peak_mb": memory,
            "facts": self.facts,
            "note": self.note,
        }


def spread(values: list[float]) -> dict[str, float]:
    """Return median, lowest and highest."""
    numbers = {"median": statistics.median(values), "low": min(values), "high": max(values)}
    return {name: float(f"{value:.4g}") for name, value in numbers.items()}


def peak_memory() -> float:
    """Return the most memory that this process has held, in MB."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10)


def resident_memory() -> float:
    """Return how much memory this process holds now, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


class Peer:
    """Another library, in a process and an environment of its own, that works when asked to.

    Args:
        name: of its environment under ``.venv-peers`` and of its script under ``peers``.
        arguments: given to the script.
    """

    def __init__(self, name: str, *arguments: str) -> None:
        self.name = name
        python = PEERS / name / "bin" / "python"
        self.process = None
        if python.exists():
            self.process = subprocess.Popen(
                [str(python), str(ROOT / "benchmarks" / "peers" / f"{name}_peer.py"), *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env={**os.environ, "PYTHONPATH": str(ROOT / "src")},
            )
            assert self._answer() == "ready"

    def contender(self, work: str, name: str = "") -> dict[str, Once]:
        """Return a contender, by default of the peer's name, that does some work of the peer's.

        None where it is not installed.
        """
        if self.process is None:
            print(f"{self.name} is not installed: `make bench` installs it", file=sys.stderr)
            return {}

        def once() -> tuple[float, float]:
            done, seconds = self._ask(work)
            return done, seconds

        return {name or self.name: once}

    def memory(self) -> float:
        """Return the most memory that its process has held, in MB; 0 where there is none."""
        return float(self._ask("memory")) if self.process else 0.0

    def close(self) -> None:
        """Let it end."""
        if self.process is not None and self.process.stdin is not None:
            self.process.stdin.close()
            self.process.wait(timeout=60)

    def _ask(self, what: str) -> Any:
        assert self.process is not None and self.process.stdin is not None
        self.process.stdin.write(f"{what}\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self.process is not None and self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the benchmark of {self.name} ended with {self.process.wait()}")
        return json.loads(line)
