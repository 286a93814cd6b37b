"""Write the tables of results: ``python docs/make_results.py`` after ``results/`` has changed.

Reads ``results/study`` and ``results/babyai``; a test checks that the pages are up to date.
"""

from collections.abc import Sequence
from functools import cache
from statistics import median

from make_tables import TABLE_2, pieces
from pages import NOT_RUN, Row, Runs, chosen, difference, gain, rate, read, success, write

from ifo_grounding.report import figure_png, markdown_table, rates_by_number
from ifo_grounding.report.results import brief
from ifo_grounding.stats import Rate, holm
from ifo_grounding.tasks import TASKS

LEVELS = ("GoToObj", "GoToLocal", "PickupLoc")
POLICIES = {
    "bot": "demonstrator",
    "true actions": "true_actions",
    "phase 1": "phase1",
    "phase 2": "phase2",
}


@cache
def runs_of(folder: str, order: Sequence[str]) -> dict[tuple[str, int], Runs]:
    """Return the runs of a folder by task and number of demonstrations, without variants."""
    found = read(folder, lambda o: (o["task"], o["demonstrations"]["n"], o["variant"]))
    plain = {(task, n): runs for (task, n, variant), runs in found.items() if not variant}
    return dict(sorted(plain.items(), key=lambda item: (order.index(item[0][0]), item[0][1])))


def studies() -> dict[tuple[str, int], Runs]:
    return runs_of("study", TASKS)


def study_rows() -> dict[tuple[str, int], Row]:
    """Return a row for each study; p is corrected for the tasks with as many demonstrations."""
    found = studies()
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
        row["p"] = f"{p[task, number]:.2g}" if p[task, number] >= 1e-4 else "< 0.0001"
        rows[task, number] = row
    return rows


def over_continued(runs: Runs) -> str:
    """Return how far phase 2 is ahead of imitation that goes on, of the seeds that ran it."""
    ran = [run for run in runs if "continued" in run["results"]]
    if not ran:
        return NOT_RUN
    aside = f" (seeds: {len(ran)})" if len(ran) < len(runs) else ""
    return brief(difference(ran, "continued", "phase2")) + aside


def choice_rows(number: int) -> list[Row]:
    """Return what the instruction classifier chose with some number of demonstrations."""
    names = {"suitable": "rate", "states served": "served", "states that can be": "servable"}
    return [
        {"task": task, **{title: chosen(runs, name) for title, name in names.items()}}
        for (task, n), runs in studies().items()
        if n == number
    ]


def efficiency_picture() -> bytes:
    """Draw what `strong` reaches on each task by number of demonstrations, and the paper's best."""
    known = {**studies(), **{(t, 80_000): pieces()[t, "strong", "pairs-5000"] for t in TASKS}}
    panels: dict[str, dict[str, dict[int, Rate]]] = {}
    for task in TASKS:
        numbers = sorted(number for of, number in known if of == task)
        panels[task] = {
            f"phase {i}": {n: rate(known[task, n], f"phase{i}") for n in numbers} for i in (1, 2)
        }
    best = {task: {"paper, 80,000": max(TABLE_2[task]) / 100} for task in TASKS}
    return figure_png(rates_by_number(panels, references=best))


def babyai_rows() -> list[Row]:
    rows = []
    for (level, number), runs in runs_of("babyai", LEVELS).items():
        row = {"level": level, "demonstrations": f"{number:,}", "seeds": len(runs)}
        for title, name in POLICIES.items():
            ran = all(name in run["results"] for run in runs)
            row[title] = success(runs if ran else None, name)
        rows.append({**row, "gain, points": gain(runs), "minutes": round(median(minutes(runs)))})
    return rows


def minutes(runs: Runs) -> list[float]:
    """Return how long the method and its evaluation took, without the references."""
    aside = ("imitate_truth", "evaluate_references")
    return [(r["seconds"] - sum(r["stages"].get(stage, 0.0) for stage in aside)) / 60 for r in runs]


def babyai_picture() -> bytes:
    panels: dict[str, dict[str, dict[int, Rate]]] = {level: {} for level in LEVELS}
    for (level, number), runs in runs_of("babyai", LEVELS).items():
        for title, name in POLICIES.items():
            if all(name in run["results"] for run in runs):
                panels[level].setdefault(title, {})[number] = rate(runs, name)
    return figure_png(rates_by_number(panels))


def tables() -> dict[str, str]:
    """Return every table by name."""
    studied = study_rows()
    found: dict[str, list[Row]] = {
        "results": [row for (_, number), row in studied.items() if number == 200],
        "up-to-2000": [row for (_, n), row in studied.items() if n <= 2000 and n != 200],
        "from-5000": [row for (_, number), row in studied.items() if number >= 5000],
        "choices": choice_rows(200),
        "babyai": babyai_rows(),
    }
    return {name: markdown_table(rows) for name, rows in found.items()}


if __name__ == "__main__":
    write(tables(), {"efficiency.png": efficiency_picture(), "babyai.png": babyai_picture()})
