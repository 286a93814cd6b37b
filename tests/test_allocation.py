"""Freed memory is handed out again, instead of new pages of zeros."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import resource, sys
import torch
from ifo_grounding.allocation import keep_freed_memory

known = sys.argv[1] == "keep" and keep_freed_memory()

def work():
    for _ in range(20):
        torch.ones(16 << 20)

work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
print(int(known), resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(choice):
    command = [sys.executable, "-c", SCRIPT, choice]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return map(int, done.stdout.split())


def test_kept_memory_costs_no_new_pages():
    known, kept = faults("keep")
    _, usual = faults("leave")
    assert not known or kept < usual / 10, f"{kept} new pages, {usual} otherwise"


RELEASE = """
import torch
from ifo_grounding.allocation import keep_freed_memory, release_freed_memory

def resident():
    with open("/proc/self/statm") as numbers:
        return int(numbers.read().split()[1]) * 4096

known = keep_freed_memory()
large, small = [], []
for _ in range(100):  # a small block behind each large one, which keeps the heap from shrinking
    large.append(torch.ones(1 << 19))
    small.append(torch.ones(16))
del large
before = resident()
release_freed_memory()
print(int(known), before - resident())
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads Linux's own counts")
def test_memory_between_blocks_in_use_goes_back():
    done = subprocess.run(
        [sys.executable, "-c", RELEASE], check=True, capture_output=True, text=True
    )
    known, released = map(int, done.stdout.split())
    assert not known or released > 100 << 20
