"""Speed of every part, beside what else does the same: ``python benchmarks/run.py [row ...]``.

Each row runs in a process of its own on the same cores; contenders of a row take turns. Writes a
results file; ``python docs/make_results.py`` makes the page of it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import torch

from ifo_grounding.files import read_json, write_json
from ifo_grounding.machine import keep_freed_memory
from ifo_grounding.report import provenance, text_table

HERE = Path(__file__).parent


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", help="names of rows; by default those of the device")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--threads", type=int, default=2, help="threads of torch, and cores for all"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, help="results file; rows measured before are kept")
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def measure_here(name: str, options: argparse.Namespace) -> dict:
    """Measure one row in this process."""
    torch.set_num_threads(options.threads)
    torch.set_flush_denormal(True)
    keep_freed_memory()
    sys.path.insert(0, str(HERE))
    import rows

    rows.DEVICE = options.device
    return rows.ROWS[name]().measure(options.repeats)


def measure_apart(name: str, options: argparse.Namespace) -> dict:
    """Measure one row in a process of its own, bound to as many cores as there are threads."""
    cores = sorted(os.sched_getaffinity(0))[: options.threads]
    asked = ["--repeats", str(options.repeats), "--threads", str(options.threads)]
    ended = subprocess.run(
        [sys.executable, __file__, name, "--alone", "--device", options.device, *asked],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env={**os.environ, "OMP_NUM_THREADS": str(options.threads)},
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
    )
    return json.loads(ended.stdout.splitlines()[-1])


def shown(row: dict) -> list[dict]:
    """Return the lines of a table about a row."""
    if not row["rates"]:
        found = row["facts"]
        return [{"row": row["name"], "what": name, "found": str(found[name])} for name in found]
    ours = next(iter(row["rates"]))
    return [
        {
            "row": row["name"] if name == ours else "",
            "contender": name,
            row["unit"]: f"{rate['median']:,.0f}",
            "ratio": "" if name == ours else f"{row['ratios'][name]['median']:.2f}",
            "MB": f"{row['peak_mb'].get(name, 0):,.0f}" if row["peak_mb"].get(name) else "",
        }
        for name, rate in row["rates"].items()
    ]


def main() -> None:
    options = arguments()
    if options.alone:
        print(json.dumps(measure_here(options.rows[0], options)))
        return
    sys.path.insert(0, str(HERE))
    import rows

    chosen = options.rows or (rows.ON_CPU if options.device == "cpu" else rows.ON_GPU)
    if unknown := set(chosen) - set(rows.ROWS):
        sys.exit(f"unknown rows {sorted(unknown)}: choose among {', '.join(rows.ROWS)}")
    made = {**provenance(), "threads": options.threads, "device": options.device}
    measured = {}
    for name in chosen:
        measured[name] = measure_apart(name, options)
        print(text_table(shown(measured[name])), flush=True)
        if options.out:
            before = read_json(options.out)["rows"] if options.out.exists() else {}
            found = {**measured[name], "provenance": made}
            write_json(options.out, {"rows": {**before, name: found}})


if __name__ == "__main__":
    main()
