"""Write every table and plot: ``python docs/make_results.py`` after ``results/`` has changed."""

from collections.abc import Sequence
from functools import cache
from itertools import chain, product
from statistics import fmean, median, mode
from typing import Any

import make_speed
import make_tables
import numpy as np
from make_tables import TABLE_2, pieces
from omegaconf import OmegaConf
from pages import (
    NOT_RUN,
    ROOT,
    Row,
    Runs,
    chosen,
    difference,
    gain,
    percent,
    ran,
    rate,
    read,
    success,
    write,
)

from ifo_grounding.baselines.config import UNLEARNED
from ifo_grounding.report import figure_png, markdown_table, rates_by_number, training_curves
from ifo_grounding.report.results import brief, unpacked
from ifo_grounding.report.theme import PALETTE, add_legend
from ifo_grounding.stats import Difference, Rate, holm, paired_difference
from ifo_grounding.tasks import TASKS

LEVELS = ("GoToObj", "GoToLocal", "PickupLoc")
PHASES = {"phase 1": "phase1", "phase 2": "phase2"}
POLICIES = {"bot": "demonstrator", "true actions": "true_actions", **PHASES}


@cache
def runs_of(folder: str, order: Sequence[str]) -> dict[tuple[str, int], Runs]:
    """Return the runs of a folder by task and number of demonstrations, without variants."""
    found = read(folder, lambda o: (o["task"], o["demonstrations"]["n"], o["variant"]))
    plain = {(task, n): runs for (task, n, variant), runs in found.items() if not variant}
    return dict(sorted(plain.items(), key=lambda item: (order.index(item[0][0]), item[0][1])))


def studied() -> dict[tuple[str, int], Runs]:
    """Return the runs of each task and number of demonstrations."""
    found = runs_of("study", TASKS) | runs_of("few", TASKS)
    return dict(sorted(found.items(), key=lambda item: (TASKS.index(item[0][0]), item[0][1])))


def study_rows() -> dict[tuple[str, int], Row]:
    """Return a row for each study; p is corrected for the tasks with as many demonstrations."""
    found = studied()
    p: dict[tuple[str, int], float] = {}
    for number in {number for _, number in found}:
        same = [key for key in found if key[1] == number]
        values = [difference(found[key], "phase1", "phase2").p_value for key in same]
        p |= dict(zip(same, holm(values), strict=True))
    rows = {}
    for (task, number), runs in found.items():
        row = {"task": task, "demonstrations": f"{number:,}", "seeds": len(runs)}
        row |= {"phase 1": success(runs, "phase1"), "phase 2": success(runs, "phase2")}
        row |= {"gain, points": gain(runs), "over continued imitation": over_continued(runs)}
        row["p"] = shown_p(p[task, number])
        rows[task, number] = row
    return rows


def over_continued(runs: Runs) -> str:
    """Return how far phase 2 is ahead of imitation that goes on, of the seeds that ran it."""
    ran = [run for run in runs if "continued" in run["results"]]
    if not ran:
        return NOT_RUN
    aside = f" (seeds: {len(ran)})" if len(ran) < len(runs) else ""
    return brief(difference(ran, "continued", "phase2")) + aside


def readme_row(row: Row) -> Row:
    """Return the README's columns: what self-examination adds where demonstrations are few."""
    phases = {"imitation": row["phase 1"], "after self-examination": row["phase 2"]}
    named = {key: row[key] for key in ("task", "demonstrations", "seeds")}
    return {**named, **phases, "difference, points": row["gain, points"]}


def choice_rows(number: int) -> list[Row]:
    """Return what the instruction classifier chose with some number of demonstrations."""
    names = {"suitable": "rate", "states served": "served", "states that can be": "servable"}
    found = {task: runs for (task, n), runs in studied().items() if n == number}
    return [{"task": t, **{n: chosen(r, names[n]) for n in names}} for t, r in found.items()]


def curves(found: dict[tuple[str, int], Runs], policies: dict[str, str]) -> dict:
    """Return the rates of policies by title, policy and number of demonstrations."""
    panels: dict[str, dict[str, dict[int, Rate]]] = {}
    for (title, number), runs in found.items():
        for label, name in policies.items():
            if ran(runs, name):
                panels.setdefault(title, {}).setdefault(label, {})[number] = rate(runs, name)
    return panels


def efficiency_picture() -> bytes:
    """Draw what `strong` reaches on each task by number of demonstrations, and the paper's best."""
    most = {(task, 80_000): pieces()[task, "strong", "pairs-5000"] for task in TASKS}
    best = {task: {"paper, 80,000": max(TABLE_2[task]) / 100} for task in TASKS}
    panels = curves(studied() | most, PHASES)
    return figure_png(rates_by_number(panels, references=best))


def babyai_rows() -> list[Row]:
    rows = []
    for (level, number), runs in runs_of("babyai", LEVELS).items():
        row = {"level": level, "demonstrations": f"{number:,}", "seeds": len(runs)}
        row |= {title: success(runs, name) for title, name in POLICIES.items()}
        rows.append({**row, "gain, points": gain(runs), "minutes": minutes(runs)})
    return rows


USES = {
    "bc": "true actions",
    "lc-rl": "true actions, steps",
    "gail": "true actions",
    "agile": "steps",
    "gaifo": "",
    "gail+bc": "true actions",
    "agile-chosen": "",
    "bco": "",
    "bco-alpha": "",
    "ours": "",
    "random": "",
}
"""Methods of Table 1, and what they use beside frames and instructions."""
FEW = 200
"""Demonstrations of the first table of Table 1."""
STRONG = ("strong", "")
"""Preset and number of frames of most runs of Table 1."""
PEERS = ("ours", "imitation", "imitation, own reward")
"""What learns GAIL in `benchmarks/gail.py`."""


Made = tuple[str, int, str, str]
"""What runs of Table 1 share: task, number of demonstrations, preset and, where they were more,
frames."""


@cache
def by_method() -> dict[Made, dict[str, Runs]]:
    """Return the runs of each method of Table 1 by what they share."""

    def made(options: dict[str, Any]) -> Made:
        frames = options["variant"].removesuffix(options["method"]).removesuffix("-")
        return options["task"], options["demonstrations"]["n"], options["preset"], frames

    found = read("baselines", lambda options: (made(options), options["method"]))
    order = {key: (TASKS.index(key[0]), key[2] != "strong", *key) for key, _ in found}
    sets = sorted(order, key=order.__getitem__)
    return {key: {m: found[key, m] for m in USES if (key, m) in found} for key in sets}


def title_of(task: str, number: int, preset: str, frames: str = "") -> str:
    """Return the name of a set of runs."""
    said = ("" if preset == "strong" else f"preset `{preset}`", frames and f"{frames} frames")
    return ", ".join(filter(None, (f"{task} {number:,}", *said)))


def baseline_rows(number: int) -> list[Row]:
    """Return a row for each method of Table 1, of every task with so many demonstrations."""
    sets = {key[0]: of for key, of in by_method().items() if key[1:] == (number, *STRONG)}
    return [
        {"method": f"`{method}`" + (f": {used}" if used else "")}
        | {task + more_seeds(*of.values()): cell(of, method) for task, of in sets.items()}
        for method, used in USES.items()
        if (number == FEW or method not in UNLEARNED) and any(method in of for of in sets.values())
    ]


def further_rows() -> list[Row]:
    """Return a row for each other preset or number of frames, of the methods that ran so."""
    sets = {key: of for key, of in by_method().items() if key[2:] != STRONG}
    ran_so = [method for method in USES if any(method in of for of in sets.values())]
    return [
        {"demonstrations": title_of(*key) + more_seeds(*of.values())}
        | {f"`{method}`": cell(of, method) for method in ran_so}
        for key, of in sets.items()
    ]


def cell(methods: dict[str, Runs], method: str) -> str:
    """Return how often a method succeeds, if it ran."""
    if method not in methods:
        return ""
    return brief(rate(methods[method], method)) + own_seeds(methods, method)


def most_seeds(*methods: Runs) -> int:
    """Return how many seeds most methods ran, of those that learn."""
    learned = [runs for runs in methods if runs[0]["options"]["method"] not in UNLEARNED]
    return mode(len(runs) for runs in learned or methods)


def more_seeds(*methods: Runs) -> str:
    """Return how many seeds most methods ran, where that is more than one."""
    most = most_seeds(*methods)
    return f", {most} seeds" if most > 1 else ""


def own_seeds(methods: dict[str, Runs], method: str) -> str:
    """Return how many seeds a method ran, where its column says another number."""
    own = len(methods[method])
    if method in UNLEARNED or own == most_seeds(*methods.values()):
        return ""
    return f", {own} seed{'s' * (own > 1)}"


def discriminator_rows() -> list[Row]:
    """Return what GAIL's and GAIfO's find in the end: demonstrations, unseen ones, the policy's."""
    rows: list[Row] = []
    for key, methods in by_method().items():
        if key[1] > 2000 or key[2:] != STRONG:
            continue
        found: Row = {}
        for method, runs in methods.items():
            said = [r["results"]["discriminator"] for r in runs if "discriminator" in r["results"]]
            if said and method in ("gail", "gaifo"):
                means = (
                    fmean(of[who] for of in said) for who in ("demonstrated", "unseen", "policy")
                )
                seeds = f"; {len(said)} seeds" if len(said) > 1 else ""
                found[f"`{method}`"] = ", ".join(f"{100 * mean:.0f}%" for mean in means) + seeds
        if found:
            rows.append({"demonstrations": title_of(*key), **found})
    return rows


def trial_rows() -> list[Row]:
    """Return how often each trial of a method of Table 1 succeeds on validation scenes."""
    space = OmegaConf.load(ROOT / "recipes/conf/reproduce.yaml").tuning
    found = read("tuning", lambda o: (o["method"], o["demonstrations"]["n"], o["variant"]))
    rows: dict[str, Row] = {}
    for method, number in product(USES, sorted({number for _, number, _ in found})):
        trials = [runs for key, runs in found.items() if key[:2] == (method, number)]
        if not trials:
            continue
        ((option, values),) = space[method].items()
        section, name = option.split(".")
        shares = {r[0]["options"][section][name]: rate(r, method).rate for r in trials}
        best = max(shares.values())
        if best == min(shares.values()):  # of bco-alpha, whose labels stay
            continue
        shown = {value: f"{value:g}: {percent([shares[value]])}" for value in values}
        texts = (f"**{text}**" if shares[value] == best else text for value, text in shown.items())
        row = rows.setdefault(method, {"method": f"`{method}`", "option": f"`{option}`"})
        row[f"{number:,}{more_seeds(*trials)}"] = ", ".join(texts)
    return list(rows.values())


def ahead_rows() -> list[Row]:
    """Return how far ours is ahead of the best rival, and of which not; p by Holm.

    After more than few, where imitation mostly leaves nothing to gain, only where ahead of all.
    """
    rows, of_tasks = [], dict[str, list[Runs]]()
    for key, found in by_method().items():
        rivals = {m: runs for m, runs in found.items() if m not in ("ours", "random")}
        both = {m: with_ours(runs, found.get("ours", [])) for m, runs in rivals.items()}
        both = {method: runs for method, runs in both.items() if runs}
        behind = {method: difference(runs, method, "ours") for method, runs in both.items()}
        row = ahead_row(title_of(*key) + more_seeds(*both.values()), behind) if both else {}
        if row and (key[1:] == (FEW, *STRONG) or row["not ahead of"] == "none"):
            rows.append(row)
        if key[1:] == (FEW, *STRONG):
            for method, runs in both.items():
                of_tasks.setdefault(method, []).append(runs)
    of_all = {m: over_tasks(of, m) for m, of in of_tasks.items() if len(of) == len(TASKS)}
    return [*rows, ahead_row("all five tasks, 200", of_all)]


def over_tasks(tasks: list[Runs], method: str) -> Difference:
    """Return how far ours is ahead in the scenes of all tasks, which are given: seeds are drawn."""
    before, after = (
        np.concatenate([unpacked(runs, name) for runs in tasks], 1) for name in (method, "ours")
    )
    return paired_difference(before, after)


def ahead_row(title: str, behind: dict[str, Difference]) -> Row:
    """Return how far ours is ahead of the best of some rivals, and of which not."""
    p = dict(zip(behind, holm([each.p_value for each in behind.values()]), strict=True))
    best = min(behind, key=lambda m: behind[m].points)
    return {
        "demonstrations": title,
        "best rival": f"`{best}`",
        "`ours` ahead, points": brief(behind[best]),
        "p": shown_p(p[best]),
        "not ahead of": ", ".join(f"`{m}`" for m in behind if p[m] >= 0.05) or "none",
    }


def with_ours(runs: Runs, ours: Runs) -> Runs:
    """Return the results of runs beside ours of the same seed, where there are any."""
    same = {run["options"]["seed"]: run["results"] for run in ours}
    there = [run for run in runs if run["options"]["seed"] in same]
    return [run | {"results": run["results"] | same[run["options"]["seed"]]} for run in there]


def shown_p(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"


def peer_rows() -> list[Row]:
    """Return how often our GAIL and that of another package succeed, by frames."""
    runs = read("peers", lambda _: "gail")["gail"]
    rows = []
    for frames in sorted({int(name.rsplit(", ", 1)[1]) for name in runs[0]["results"]}):
        rates = {name: success(runs, f"{name}, {frames}") for name in PEERS}
        rows.append({"frames": f"{frames:,}", "seeds": len(runs), **rates})
    return rows


def mean_curve(runs: Runs) -> dict[int, float]:
    """Return the success on validation scenes by frames, the mean of seeds."""
    found: dict[int, list[float]] = {}
    for frames, share in chain(*(run["results"].get("curve", ()) for run in runs)):
        found.setdefault(frames, []).append(share)
    return {frames: fmean(shares) for frames, shares in found.items()}


def baseline_curves() -> bytes:
    """Draw the curves of methods that learn by policy gradient, of the most frames that ran."""
    rows, panels = [], {}
    for task, number in product(("move", "move-udlr", "pick"), (200, 2000)):
        key, means = (task, number, "strong"), {}
        for found in (runs for made, runs in by_method().items() if made[:3] == key):
            means |= {m: mean for m, runs in found.items() if (mean := mean_curve(runs))}
        title = title_of(*key)
        panels[title] = {f"{title} {method}": method for method in means}
        for method, mean in means.items():
            rows += [{"step": frames, f"{title} {method}": mean[frames]} for frames in mean]
    figure = training_curves(sorted(rows, key=lambda row: row["step"]), panels)
    drawn = {method for panel in panels.values() for method in panel.values()}
    colours = dict(zip((method for method in USES if method in drawn), PALETTE, strict=False))
    for axes in figure.axes[: len(panels)]:
        axes.set_xlim(0, 1.02 * max(max(line.get_xdata()) for line in axes.lines))
        axes.set_ylim(-0.05, 1.05)
        axes.set_xlabel("million frames")
        axes.xaxis.set_major_formatter(lambda frames, _: f"{frames / 1e6:g}")
        for line in axes.lines:
            line.set_color(colours[str(line.get_label())])
        if legend := axes.get_legend():
            legend.remove()
    lines = {str(line.get_label()): line for axes in figure.axes for line in axes.lines}
    shown = [lines[method] for method in colours]
    add_legend(figure, handles=shown, loc="outside lower left", ncols=3)
    return figure_png(figure)


def minutes(runs: Runs) -> int:
    """Return how long the method and its evaluation took, without the references."""
    aside = ("imitate_truth", "evaluate_references")
    seconds = [r["seconds"] - sum(r["stages"].get(stage, 0.0) for stage in aside) for r in runs]
    return round(median(seconds) / 60)


def tables() -> dict[str, str]:
    """Return every table by name."""
    few = {("move", 40), ("move", 50), *((task, 200) for task in TASKS)}
    rows = study_rows()
    found: dict[str, list[Row]] = {
        "few": [readme_row(row) for key, row in rows.items() if key in few],
        "results": [row for key, row in rows.items() if key[1] <= 200],
        "up-to-2000": [row for key, row in rows.items() if 200 < key[1] <= 2000],
        "choices": choice_rows(200),
        "babyai": babyai_rows(),
        **{f"baselines-{number}": baseline_rows(number) for number in (FEW, 2000, 20_000)},
        "baselines-further": further_rows(),
        "ours-ahead": ahead_rows(),
        "discriminators": discriminator_rows(),
        "trials": trial_rows(),
        "peers": peer_rows(),
    }
    here = {name: markdown_table(rows) for name, rows in found.items()}
    return here | make_tables.tables() | make_speed.tables()


def pictures() -> dict[str, bytes]:
    """Return every plot of results by the name of its file."""
    babyai = rates_by_number(curves(runs_of("babyai", LEVELS), POLICIES))
    return {
        "efficiency.png": efficiency_picture(),
        "babyai.png": figure_png(babyai),
        "baselines.png": baseline_curves(),
    }


if __name__ == "__main__":
    write(tables(), pictures())
