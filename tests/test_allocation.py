"""Freed memory is handed out again, instead of new pages of zeros, and goes back when asked."""

import multiprocessing
import platform
import resource
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
import torch

from ifo_grounding.machine import keep_freed_memory, release_freed_memory


def new_pages(rounds):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        torch.ones(16 << 20)  # of 64 MiB
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def keep_and_release():
    keep_freed_memory()
    new_pages(20)
    kept = new_pages(5)
    large, small = [], []
    for _ in range(100):  # a small block behind each large one, which keeps the heap from shrinking
        large.append(torch.ones(1 << 19))
        small.append(torch.ones(16))
    del large
    before = resident()
    release_freed_memory()
    return kept, before - resident()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the choice is glibc's")
def test_freed_memory_is_kept_until_it_is_released():
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as pool:
        kept, released = pool.submit(keep_and_release).result()
    assert kept < 5 * (64 << 20) / resource.getpagesize() / 10  # a tenth of all pages
    assert released > 100 << 20
