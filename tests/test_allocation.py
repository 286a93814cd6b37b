"""Freed memory is handed out again, instead of new pages of zeros."""

import subprocess
import sys

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
