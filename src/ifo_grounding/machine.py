"""What computes: a device, its name, and how many threads are fastest on this machine now."""

from __future__ import annotations

import contextlib
import math
import os
import platform
import time
from pathlib import Path

import torch

from ifo_grounding.errors import UserError

MOST_THREADS = torch.get_num_threads()
"""Torch's own choice, which heeds ``OMP_NUM_THREADS`` and the affinity of the process."""
QUOTA = Path("/sys/fs/cgroup/cpu.max")
REVIEW = 30.0
"""Seconds after which the number of threads that was fastest is measured anew."""
_due = math.inf


def machine_of(device: torch.device | str) -> str:
    """Return the name of what computes on a device.

    >>> machine_of("cpu") == processor()
    True
    """
    is_gpu = torch.device(device).type == "cuda"
    return torch.cuda.get_device_name(device) if is_gpu else processor()


def processor() -> str:
    """Return the name of this machine's processor."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def choose_threads(threads: int | str) -> None:
    """Compute with so many threads or, with ``auto``, with as many as are fastest now.

    Training loops measure the latter anew every half a minute (:func:`review_threads`).
    """
    global _due
    auto = threads == "auto"
    torch.set_num_threads(fastest_threads() if auto else int(threads))
    _due = time.monotonic() + REVIEW if auto else math.inf


def review_threads() -> None:
    """Measure anew which number of threads is fastest, if it is chosen by that and time to."""
    if time.monotonic() > _due:
        choose_threads("auto")


def cores() -> int:
    """Return how many cores this process may use, by its affinity and by its control group."""
    most = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):  # "max 100000", where there is no quota
        quota, period = map(int, QUOTA.read_text().split())
        most = max(1, min(most, quota // period))
    return most


def fastest_threads() -> int:
    """Return 1, or how many threads this process may use, where they do small layers faster now."""
    most = min(MOST_THREADS, cores())
    seconds: dict[int, list[float]] = {1: [], most: []}
    batch = torch.ones(256, 256)
    for number in [*seconds] * 20:
        torch.set_num_threads(number)
        begun = time.perf_counter()
        for _ in range(5):
            (batch @ batch).relu().mul(0.5)
        seconds[number].append(time.perf_counter() - begun)
    one, several = (sorted(seconds[number])[10] for number in (1, most))
    return most if several < 0.9 * one else 1  # by a tenth at least


def check_device(device: torch.device | str) -> None:
    """Raise :class:`UserError` unless networks can be on a device here."""
    try:
        kind = torch.device(device).type
    except (RuntimeError, TypeError, ValueError):  # no name, no number, or a GPU where none is
        kind = "unknown"
    if kind not in ("cpu", "cuda"):
        raise UserError(f"device={device} is none: use cpu, cuda or cuda:0")
    if kind == "cuda" and (torch.device(device).index or 0) >= torch.cuda.device_count():
        raise UserError(f"device={device}: torch sees no such GPU here; use device=cpu")
