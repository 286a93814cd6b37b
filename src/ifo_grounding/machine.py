"""What computes: a device, its name, how many cores there are, and how memory is handed out."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
from pathlib import Path

import torch

from ifo_grounding.errors import UserError

QUOTA = Path("/sys/fs/cgroup/cpu.max")
TRIM_THRESHOLD, MMAP_MAX = -1, -4
"""Names of glibc's parameters, from malloc.h."""


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


def cores() -> int:
    """Return how many cores this process may use, by its affinity and by its control group."""
    most = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):  # "max 100000", where there is no quota
        quota, period = map(int, QUOTA.read_text().split())
        most = max(1, min(most, quota // period))
    return most


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


def keep_freed_memory() -> None:
    """Let the C library, where it is glibc, keep the memory that is freed, to hand it out again.

    Otherwise a tensor of megabytes costs more to get from the system than to fill. Call it once,
    before the work begins. The process then holds on to the most that it ever needed, and to more
    where sizes differ: :func:`release_freed_memory` gives back what is free.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(MMAP_MAX, 0)
        mallopt(TRIM_THRESHOLD, 2**31 - 1)


def release_freed_memory() -> None:
    """Let glibc give back the memory that is free now, also between blocks that are in use."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
