"""How the process gets its memory."""

from __future__ import annotations

import ctypes

TRIM_THRESHOLD, MMAP_MAX = -1, -4
"""Names of glibc's parameters, from malloc.h."""


def keep_freed_memory() -> bool:
    """Let the C library keep the memory that is freed, to hand it out again.

    It returns large blocks to the system otherwise, which gives them back page by page, each filled
    with zeros: on a CPU, a tensor of megabytes costs more to get than to fill. Call it once, before
    the work begins. The process then holds on to the most that it ever needed, and to more where
    blocks of many sizes come and go: :func:`release_freed_memory` gives back what is free.

    Returns:
        Whether there is such a choice here: on Linux with glibc, not elsewhere.

    >>> isinstance(keep_freed_memory(), bool)
    True
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(mallopt(MMAP_MAX, 0)) and bool(mallopt(TRIM_THRESHOLD, 2**31 - 1))


def release_freed_memory() -> bool:
    """Give the system back the memory that is free now, also between blocks that are in use.

    Returns:
        Whether there was any to give back, as far as the C library can say.

    >>> isinstance(release_freed_memory(), bool)
    True
    """
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return False
    return bool(trim(0))
