"""What a peer's script does: work when a line asks for it, and say how much and how long."""

import json
import os
import resource
import sys
import time
from collections.abc import Callable


def serve(works: dict[str, Callable[[], float]]) -> None:
    # What a library prints must not be taken for an answer.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def answer(what) -> None:
        print(json.dumps(what), file=answers, flush=True)

    answer("ready")
    for line in sys.stdin:
        work = line.strip()
        if work == "memory":
            answer(round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10))
            continue
        start = time.perf_counter()
        done = works[work]()
        answer([done, time.perf_counter() - start])
