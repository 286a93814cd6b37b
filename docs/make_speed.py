"""Write the table of speeds: ``python docs/make_speed.py`` after ``make bench``.

Reads ``results/bench/*.json`` and writes the parts of ``docs/speed.md`` between its marks, and
the picture of how costs grow. A test checks that the table is up to date.
"""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ifo_grounding.files import atomic_write, read_json
from ifo_grounding.report import markdown_table, save_figure
from ifo_grounding.report.tables import renewed

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "speed.md"
PICTURE = ROOT / "docs" / "assets" / "growth.png"
OURS = "ifo-grounding"
ORDER = (
    *("step", "pixels", "rollout", "gymnasium", "collector-strong", "collector-paper", "sampler"),
    *("imitation-strong", "imitation-paper", "labelling", "transitions", "recording", "memory"),
    *("whole", "growth"),
)
"""Of the rows in the table; others come last."""


def measured(device: str = "cpu") -> dict[str, dict[str, Any]]:
    """Return the rows that were measured on a device."""
    path = ROOT / "results" / "bench" / f"{device}.json"
    found = read_json(path)["rows"] if path.exists() else {}
    return {name: found[name] for name in sorted(found, key=place)}


def place(name: str) -> int:
    return ORDER.index(name) if name in ORDER else len(ORDER)


def lines(row: dict[str, Any]) -> list[dict[str, str]]:
    """Return the rows of the table of rates about one thing: ours, and what it is compared with."""
    rates, reach = row["rates"], row["reach"]
    asked = []
    for name, value in reach.items():
        found = rates[OURS] if name == "rate" else row["ratios"].get(name)
        wanted = short(value) if name == "rate" else f"{value:g} times {name}"
        verdict = "not run" if found is None else "yes" if found["median"] >= value else "no"
        asked.append(f"{wanted}: {verdict}")
    shown = []
    for name in [OURS, *(other for other in rates if other != OURS)]:
        rate, ours = rates[name], name == OURS
        between = f"{short(rate['median'])} [{short(rate['low'])}, {short(rate['high'])}]"
        shown.append(
            {
                "what": f"**{row['name']}**, {row['unit']}" if ours else "",
                "by": f"**{name}**" if ours else name,
                "rate": between,
                "we are as fast": "" if ours else times(row["ratios"][name]),
                "asked": "<br>".join(asked) if ours else "",
            }
        )
    return shown


def times(ratio: dict[str, float]) -> str:
    median, low, high = (three_digits(ratio[name]) for name in ("median", "low", "high"))
    return f"{median}x [{low}, {high}]"


def three_digits(value: float) -> str:
    """Return a number with three digits that count, or all before the point."""
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def short(value: float) -> str:
    """Return a number of three digits, with K or M.

    >>> short(1234567.0), short(25_300.0), short(990.0)
    ('1.23M', '25.3K', '990')
    """
    for size, name in ((1e6, "M"), (1e3, "K")):
        if value >= size:
            return f"{value / size:.3g}{name}"
    return f"{value:.3g}"


def fact(value: float) -> str:
    """Return a number with as many digits as it needs.

    >>> fact(952268), fact(99.95)
    ('952,268', '99.95')
    """
    return f"{value:,.0f}" if value == round(value) else f"{value:,.4g}"


def sections() -> dict[str, str]:
    """Return the parts of the page: of two cores, for which speeds are asked, and of a GPU."""
    there = {name: {**row, "reach": {}} for name, row in measured("cuda").items()}
    found = {"speed": measured(), "speed-gpu": there}
    return {mark: tables(rows) if rows else "Not run." for mark, rows in found.items()}


def tables(rows: dict[str, dict[str, Any]]) -> str:
    """Return the tables of what was measured on one device."""
    made: dict[str, dict[str, None]] = {}
    for row in rows.values():
        of = row["provenance"]
        machine = f"{of['machine']}, {of['threads']} threads, torch {of['torch']}"
        machine = f"{of['gpu']} beside {machine}" if of["device"] != "cpu" else machine
        made.setdefault(machine, {})[f"`{of['commit']}`"] = None
    machines = [f"{machine}, commits {', '.join(commits)}" for machine, commits in made.items()]
    rates = [shown for row in rows.values() if row["rates"] for shown in lines(row)]
    if not any(shown["asked"] for shown in rates):
        rates = [{k: v for k, v in shown.items() if k != "asked"} for shown in rates]
    notes = [f"- {row['name']}: {row['note']}." for row in rows.values() if row["note"]]
    facts = [
        {"what": row["name"], "measured": name, "value": fact(value)}
        for row in rows.values()
        for name, value in row["facts"].items()
    ]
    parts = ["; ".join(machines) + ".", markdown_table(rates)]
    parts += [markdown_table(facts)] if facts else []
    parts += ["\n".join(notes)] if notes else []
    return "\n\n".join(parts)


def growth() -> Figure | None:
    """Draw how long things take by their size, and a line along which cost grows as size does."""
    curves = measured().get("growth", {}).get("curves")
    if not curves:
        return None
    figure = Figure(figsize=(9.6, 3.2), layout="constrained")
    for axes, (name, curve) in zip(figure.subplots(1, len(curves)), curves.items(), strict=True):
        sizes = sorted(map(int, curve))
        seconds = [curve[str(size)] for size in sizes]
        linear = [seconds[-1] * size / sizes[-1] for size in sizes]
        axes.loglog(sizes, linear, color="#9aa0a6", linestyle="--", label="linear")
        axes.loglog(sizes, seconds, color="#2f5fd0", marker="o", markersize=4, label="measured")
        axes.set_title(name, fontsize=9, loc="left")
        axes.set_ylabel("seconds", fontsize=8)
        axes.tick_params(labelsize=8, which="both")
        axes.legend(frameon=False, fontsize=8)
    return figure


def written() -> dict[Path, str]:
    """Return what the page should say."""
    text = PAGE.read_text()
    for mark, part in sections().items():
        text = renewed(text, mark, f"\n{part}\n")
    return {PAGE: text}


def main() -> None:
    for path, text in written().items():
        with atomic_write(path) as temporary:
            temporary.write_text(text)
    if (figure := growth()) is not None:
        save_figure(figure, PICTURE)


if __name__ == "__main__":
    main()
