"""Speed of the world and of recording: ``python benchmarks/world.py [threads]``.

Medians of five repeats on this machine, printed with what it is. Wall times on shared machines are
noisy: compare numbers of one run.
"""

import resource
import statistics
import sys
import time
from collections.abc import Callable

import torch

from ifo_grounding.data import record_demonstrations
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.report import provenance, text_table
from ifo_grounding.tasks import TASKS
from ifo_grounding.world import random_layout, render, step

REPEATS = 5
DEMONSTRATIONS = 80_000


def seconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median time of some repeats, after one that does not count."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def world_rows() -> list[dict]:
    many, some = random_layout(4096), random_layout(1024)
    action = torch.randint(6, (4096,))
    env = PickAndPlaceEnv("move", num_envs=1024, seed=0)
    rates = {
        "world steps, batch 4,096": 4096 / seconds(lambda: step(many, action)),
        "rendered frames, batch 1,024": 1024 / seconds(lambda: render(some)),
        "PickAndPlaceEnv.rollout frames, batch 1,024": 20
        * 1024
        / seconds(lambda: env.rollout(20, break_when_any_done=False)),
    }
    return [{"what": name, "per second": round(rate)} for name, rate in rates.items()]


def recording_rows() -> list[dict]:
    rows = []
    for task in TASKS:
        start = time.perf_counter()
        demos = record_demonstrations(task, DEMONSTRATIONS, seed=0)
        elapsed = time.perf_counter() - start
        stored = demos.codes.nbytes + demos.tokens.nbytes + demos.lengths.nbytes
        rows.append(
            {
                "task": task,
                "frames": demos.n_frames,
                "seconds": round(elapsed, 1),
                "MB stored": round(stored / 2**20),
            }
        )
    return rows


def main() -> None:
    if len(sys.argv) > 1:
        torch.set_num_threads(int(sys.argv[1]))
    print(provenance())
    print(text_table(world_rows()))
    print(text_table(recording_rows(), title=f"\nrecording {DEMONSTRATIONS:,} demonstrations"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(f"peak memory of this process: {peak:.0f} MB")


if __name__ == "__main__":
    main()
