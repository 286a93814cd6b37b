"""How far a command is: bars on a terminal, a line every half a minute in a log."""

from __future__ import annotations

import sys
import threading
import time
from functools import cache
from types import SimpleNamespace
from typing import Any

from tqdm import tqdm

EVERY = 30.0
"""Seconds between two lines."""
LINE = "{desc}: {n_fmt} of {total_fmt}, {elapsed} gone, {remaining} left"
NOWHERE = SimpleNamespace(write=len, flush=int)
"""A file that keeps nothing."""
_told: list[str] = []
"""What this process works on, where it tells how far it is."""


def tell_progress(stage: str | None) -> None:
    """Tell from now on how far a stage is, or nothing."""
    _told[:] = [stage] if stage else []
    if stage and not sys.stderr.isatty():
        _begin()


@cache
def _begin() -> None:
    threading.Thread(target=_tell, args=(time.monotonic(),), daemon=True).start()


def progress_bar(*args: Any, shown: bool | None = None, **options: Any) -> Any:
    """Return a bar of tqdm, silent where a log gets lines; by default shown if a stage is told."""
    if _told and not sys.stderr.isatty():
        options |= {"file": NOWHERE, "mininterval": 0, "miniters": 1}
    hidden = not (_told if shown is None else shown)
    return tqdm(*args, **{"disable": hidden, **options})


def _tell(begun: float) -> None:
    """Write lines with the stage and the bars that are at work."""
    while True:
        time.sleep(EVERY)
        for stage in tuple(_told):
            bars = sorted(getattr(tqdm, "_instances", ()), key=lambda one: one.start_t)
            parts = [tqdm.format_meter(**{**one.format_dict, "bar_format": LINE}) for one in bars]
            now = f"{stage}: running ({time.monotonic() - begun:,.0f} s since the start)"
            print("; ".join([now, *parts]), file=sys.stderr, flush=True)
