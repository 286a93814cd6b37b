"""The paper's tables and figures with the numbers of here."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from pages import NOT_RUN, Row, Runs, chosen, difference, gain, percent, read, success

from ifo_grounding.evaluation.endings import ENDINGS
from ifo_grounding.report import markdown_table
from ifo_grounding.report.results import brief
from ifo_grounding.stats import Rate, wilson
from ifo_grounding.tasks import TASKS
from ifo_grounding.tasks.goals import REASONS

PRESETS = ("paper", "strong")
EPISODES = 500
"""The paper's rates are multiples of 0.2%: they look like this many episodes each."""
TABLE_2 = {
    "move": (76.6, 79.4, 78.4),
    "move-udlr": (69.0, 73.4, 72.4),
    "pick": (13.0, 15.0, 15.4),
    "pick-out": (32.8, 34.0, 34.6),
    "pick-udlr": (22.6, 26.0, 24.8),
}
"""The paper's success after phase 1, and after phase 2 with 5,000 and with 10,000 pairs."""
TABLE_3 = dict(zip(TASKS, (91.725, 81.145, 90.190, 77.940, 76.810), strict=True))
"""The paper's suitable instructions among those chosen."""
TABLE_4 = dict(
    zip(TASKS, ((62.8, 68.4), (56.8, 60.6), (11.2, 14.6), (27.4, 29.8), (19.8, 21.0)), strict=True)
)
"""The paper's success on held-out pairs of colour and shape, after phase 1 and after phase 2."""


@cache
def pieces() -> dict[tuple[str, str, str], Runs]:
    """Return what the paper's tables are made from, by task, preset and phase."""
    # Options of files from before the two presets name the networks.
    return read("tables", lambda o: (o["task"], o.get("preset") or o["network"], o["variant"]))


def of_paper(percentage: float) -> Rate:
    """Return a rate of the paper with the interval that its number of episodes implies."""
    return wilson(round(percentage / 100 * EPISODES), EPISODES)


def gain_of_paper(before: Rate, after: Rate) -> str:
    """Return the difference of two rates of different episodes (Newcombe 1998, his method 10)."""
    points = after.rate - before.rate
    low = points - math.hypot(after.rate - after.low, before.high - before.rate)
    high = points + math.hypot(after.high - after.rate, before.rate - before.low)
    return f"{100 * points:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"


def table_2(task: str) -> Row:
    first, *later = TABLE_2[task]
    row = {
        "published, phase 1": brief(of_paper(first)),
        "published, best phase 2": brief(of_paper(max(later))),
    }
    for preset in PRESETS:
        runs = pieces().get((task, preset, "pairs-5000"))
        row |= {f"`{preset}`, phase {i}": success(runs, f"phase{i}") for i in (1, 2)}
    return row


def gains(task: str) -> Row:
    found, row = pieces(), {}
    first, *later = map(of_paper, TABLE_2[task])
    for pairs, told in zip((5000, 10_000), later, strict=True):
        row[f"published, {pairs:,} pairs"] = gain_of_paper(first, told)
        row[f"`paper`, {pairs:,} pairs"] = gain(found.get((task, "paper", f"pairs-{pairs}")))
    row["paid for goals"] = gain(found.get((task, "paper", "goal-pairs-5000")))
    control = found.get((task, "paper", "goal-continued"))
    compared = brief(difference(control, "phase1", "continued")) if control else NOT_RUN
    return {**row, "imitation continued": compared}


def table_3(task: str) -> Row:
    row = {"published": f"{TABLE_3[task]:.1f}%"}
    for preset in PRESETS:
        runs = pieces()[task, preset, "phase-1"]
        shares = [run["results"]["suitability"]["rate"]["rate"] for run in runs]
        between = f"{100 * min(shares):.1f}, {100 * max(shares):.1f}"
        row[f"`{preset}`"] = f"{percent(shares)} [{between}]"
        row[f"`{preset}`, served"] = chosen(runs, "served")
    return {**row, "can be served": chosen(runs, "servable")}


def zero_shot(task: str) -> Row:
    """Return Table 4: success after phase 1 on pairs held out from instructions, and on others."""
    row = {"published, phase 1 / 2": "{}% / {}%".format(*TABLE_4[task])}
    for preset in PRESETS:
        runs = pieces()[task, preset, "zero-shot"]
        both = f"{success(runs, 'phase1')} / {percent(map(of_trained, runs))}"
        row[f"`{preset}`, new / other pairs"] = both
    unseen = pieces()[task, "strong", "zero-shot-unseen"]
    return {**row, "`strong`, new pairs never seen": success(unseen, "phase1")}


def zero_shot_gains(task: str) -> Row:
    """Return what phase 2 gains on held-out pairs."""
    return {f"`{name}`": gain(pieces()[task, name, "zero-shot-pairs-5000"]) for name in PRESETS}


def of_trained(run: dict[str, Any]) -> float:
    """Return the success after phase 1 on instructions that name no held-out pair."""
    counts = run["results"]["trained"]["phase1"]["counts"]
    return counts["success"] / sum(counts.values())


def counts(phase: str, preset: str, cells: Callable[[Runs], Row]) -> list[Row]:
    found = {task: pieces().get((task, preset, phase)) for task in TASKS}
    return [{"task": task, "seeds": len(of), **cells(of)} for task, of in found.items() if of]


def wrong_choices(runs: Runs) -> Row:
    """Return Figure 5: what is wrong with unsuitable choices, added over seeds."""
    errors = [run["results"]["suitability"]["errors"] for run in runs]
    return {name: f"{sum(one[name] for one in errors):,}" for name in REASONS[1:-1]}


def changes(runs: Runs) -> Row:
    """Return Figure 6: scenes that one phase alone solves, by how the other one failed there."""
    found = [run["results"]["changes"] for run in runs]
    row = {}
    for name in ENDINGS[1:]:
        won, lost = (sum(one[part][name] for one in found) for part in ("gained", "lost"))
        row[name] = f"{won:,} / {lost:,}"
    paths = (sum(one[f"{which} path"] for one in found) for which in ("other", "same"))
    return {**row, "both, other / same path": "{:,} / {:,}".format(*paths)}


def tables() -> dict[str, str]:
    """Return every table by name."""
    by_task: dict[str, Callable[[str], Row]] = {
        "paper": table_2,
        "gains": gains,
        "table-3": table_3,
        "zero-shot": zero_shot,
        "zero-shot-gains": zero_shot_gains,
    }
    found = {name: [{"task": task, **row(task)} for task in TASKS] for name, row in by_task.items()}
    found |= {
        "figure-5-paper": counts("phase-1", "paper", wrong_choices),
        "figure-5-strong": counts("phase-1", "strong", wrong_choices),
        "figure-6": counts("pairs-5000", "paper", changes),
        "figure-6-goals": counts("goal-pairs-5000", "paper", changes),
    }
    return {name: markdown_table(rows) for name, rows in found.items()}
