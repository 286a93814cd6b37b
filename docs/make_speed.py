"""The tables of speeds, of what ``make bench`` and ``benchmarks/scale.py`` measured."""

from collections.abc import Collection
from typing import Any

from pages import RESULTS

from ifo_grounding.files import read_json
from ifo_grounding.report import markdown_table

OURS = "ifo-grounding"
ORDER = (
    *("step", "pixels", "worlds", "worlds-pixels", "rollout", "gymnasium", "collector-strong"),
    *("collector-paper", "sampler", "imitation-strong", "imitation-paper"),
    *("labelling", "transitions", "recording", "memory", "whole"),
)
"""Of the rows in the tables; others come last."""


def measured(device: str) -> dict[str, dict[str, Any]]:
    """Return the rows that were measured on a device."""
    found = read_json(RESULTS / "bench" / f"{device}.json")["rows"]
    return dict(sorted(found.items(), key=lambda item: ([*ORDER, item[0]].index(item[0]), item[0])))


def rate_row(row: dict[str, Any]) -> dict[str, str]:
    """Return our rate of one thing, and how many times as fast as others it is."""
    rates, ratios = row["rates"], row["ratios"]
    return {
        "what": f"{row['name']}, {row['unit']}",
        "rate": between(rates[OURS]),
        "times as fast as": "<br>".join(f"{name}: {between(r)}" for name, r in ratios.items()),
    }


def between(value: dict[str, float]) -> str:
    """Return a median with the lowest and the highest value, each with K or M."""
    return f"{short(value['median'])} [{short(value['low'])}, {short(value['high'])}]"


def short(value: float) -> str:
    """Return a number of three digits, with K or M."""
    for size, name in ((1e6, "M"), (1e3, "K")):
        if value >= size:
            return f"{value / size:.3g}{name}"
    return f"{value:.3g}"


def fact_row(row: dict[str, Any]) -> dict[str, str]:
    facts = (f"{name}: {f'{v:,.0f}' if v >= 100 else f'{v:g}'}" for name, v in row["facts"].items())
    return {"what": row["name"], "measured": "<br>".join(facts)}


def on_device(rows: dict[str, dict[str, Any]], said: Collection[str] = ()) -> str:
    """Return the tables of what was measured on one device, without the notes on rows ``said``."""
    made: dict[str, dict[str, None]] = {}
    for row in rows.values():
        of = row["provenance"]
        machine = f"{of['machine']}, {of['threads']} threads, torch {of['torch']}"
        machine = f"{of['gpu']} beside {machine}" if of["device"] != "cpu" else machine
        made.setdefault(machine, {})[f"`{of['commit']}`"] = None
    parts = [f"{machine}, commits {', '.join(commits)}." for machine, commits in made.items()]
    rates = [rate_row(row) for row in rows.values() if row["rates"]]
    facts = [fact_row(row) for row in rows.values() if row["facts"]]
    parts += [markdown_table(part) for part in (rates[:7], rates[7:], facts) if part]
    of_note: dict[str, list[str]] = {}
    for row in (row for name, row in rows.items() if name not in said):
        of_note.setdefault(row["note"], []).append(row["name"])
    notes = [f"- {'; '.join(names)}: {note}." for note, names in of_note.items() if note]
    return "\n\n".join([*parts, "\n".join(notes)])


def of_scale() -> str:
    """Return the tables of what was measured of Ray and torchrun, and of the model made of it."""
    found = read_json(RESULTS / "bench" / "scale.json")
    lines = []
    for row in found["rows"].values():
        for against, ratio in row["ratios"].items():
            (ours,) = row["rates"].keys() - row["ratios"].keys()
            line = {"what": f"{row['name']}: {ours}", "times as fast as": against}
            lines.append({**line, "measured": between(ratio)})
    limit, model = found["growth"]["limit"], []
    for row in found["growth"]["rows"][::2]:
        line = {"workers": f"{row['workers']}", "frames/s": short(row["frames/s"])}
        model.append({**line, "if learning took no time": short(row["bound"])})
    text = (
        "A model of BabyAI practice, 64 worlds a worker, 1 Gbit/s, from one process's times: "
        f"beyond {limit['frames/s']:.1f} workers the learner is the bottleneck, beyond "
        f"{limit['bound']:.0f} if learning took no time."
    )
    return "\n\n".join([markdown_table(lines), text, markdown_table(model)])


def tables() -> dict[str, str]:
    """Return the tables of two cores, and of a GPU."""
    here = measured("cpu")
    gpu = on_device(measured("cuda"), said=here)
    return {"speed": on_device(here), "speed-gpu": gpu, "scale": of_scale()}
