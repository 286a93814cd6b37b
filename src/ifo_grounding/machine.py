"""What computes: the name of a processor or of a GPU."""

from __future__ import annotations

import platform
from pathlib import Path

import torch


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
