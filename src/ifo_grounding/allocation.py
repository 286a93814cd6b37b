"""How the process gets its memory, where its C library is glibc; elsewhere nothing happens."""

from __future__ import annotations

import contextlib
import ctypes

TRIM_THRESHOLD, MMAP_MAX = -1, -4
"""Names of glibc's parameters, from malloc.h."""


def keep_freed_memory() -> None:
    """Let the C library keep the memory that is freed, to hand it out again.

    Otherwise a tensor of megabytes costs more to get from the system than to fill. Call it once,
    before the work begins. The process then holds on to the most that it ever needed, and to more
    where sizes differ: :func:`release_freed_memory` gives back what is free.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(MMAP_MAX, 0)
        mallopt(TRIM_THRESHOLD, 2**31 - 1)


def release_freed_memory() -> None:
    """Give the system back the memory that is free now, also between blocks that are in use."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
