"""Where a number comes from: command, commit, machine."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

from ifo_grounding import __version__
from ifo_grounding.machine import machine_of, processor


def provenance() -> dict[str, Any]:
    """Return what a number has to be read with: versions, commit and machine, with its GPU.

    The commit is that of the source checkout, with ``+`` behind it where files differ from it; an
    installed package has none.

    >>> {"version", "commit", "torch", "machine"} <= provenance().keys()
    True
    """
    return {
        "version": __version__,
        "commit": _commit(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "machine": processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        **({"gpu": machine_of("cuda")} if torch.cuda.is_available() else {}),
    }


def _commit() -> str | None:
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", ":!results")
        return git("rev-parse", "--short=12", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None
