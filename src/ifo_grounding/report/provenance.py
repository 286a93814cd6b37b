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
    """Return the commit, with a plus where files other than results changed since."""
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return None
    commit = _git(root, "rev-parse", "--short=12", "HEAD")
    changed = _git(root, "status", "--porcelain", "--untracked-files=no", ":!results")
    return f"{commit}+" if commit and changed else commit


def _git(root: Path, *arguments: str) -> str | None:
    try:
        ended = subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return ended.stdout.strip()
