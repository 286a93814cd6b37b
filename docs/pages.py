"""What the scripts of the pages share: reading results, and writing tables into pages.

A page shows a table between ``<!-- NAME -->`` and ``<!-- /NAME -->``; a test compares the two.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from ifo_grounding.files import read_json
from ifo_grounding.report.results import brief, unpacked
from ifo_grounding.stats import Difference, Rate, paired_difference, rate_over_seeds

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"
ASSETS = ROOT / "docs" / "assets"
TABLE = re.compile(r"<!-- (?P<name>[a-z0-9-]+) -->\n.*?<!-- /(?P=name) -->", re.DOTALL)
NOT_RUN = "not run"

Runs = list[dict[str, Any]]
Row = dict[str, Any]


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def renewed(text: str, tables: Mapping[str, str]) -> str:
    """Return a page with its tables renewed; others than those of ``tables`` stay."""

    def table(found: re.Match[str]) -> str:
        name = found["name"]
        return f"<!-- {name} -->\n{tables[name]}\n<!-- /{name} -->" if name in tables else found[0]

    return TABLE.sub(table, text)


def write(tables: Mapping[str, str], pictures: Mapping[str, bytes]) -> None:
    """Write tables into every page that shows them, and pictures into ``docs/assets``."""
    for page in pages():
        page.write_text(renewed(page.read_text(), tables))
    for name, content in pictures.items():
        (ASSETS / name).write_bytes(content)


def read(folder: str, key: Callable[[dict[str, Any]], Any]) -> dict[Any, Runs]:
    """Return the runs of a folder of results, their seeds in order, by what their options say."""
    found: dict[Any, Runs] = {}
    for path in sorted((RESULTS / folder).glob("*.json")):
        run = read_json(path)
        stream = run["options"].get("evaluate", {}).get("stream", "evaluation")
        if stream != ("validation" if folder == "tuning" else "evaluation"):
            raise ValueError(f"{path} is of {stream} scenes")
        found.setdefault(key(run["options"]), []).append(run)
    return found


def rate(runs: Runs, name: str) -> Rate:
    """Return how often a policy succeeds, with an interval over seeds and scenes."""
    return rate_over_seeds(unpacked(runs, name))


def difference(runs: Runs, first: str, second: str) -> Difference:
    """Return by how much a second policy succeeds more often than a first on the same scenes."""
    return paired_difference(unpacked(runs, first), unpacked(runs, second))


def success(runs: Runs | None, name: str) -> str:
    """Return how often a policy succeeds, where every seed ran it."""
    return brief(rate(runs, name)) if runs and ran(runs, name) else NOT_RUN


def ran(runs: Runs, name: str) -> bool:
    return all(name in run["results"] for run in runs)


def gain(runs: Runs | None) -> str:
    """Return what phase 2 gains, and with how many seeds no checkpoint of it beat phase 1."""
    if not runs:
        return NOT_RUN
    kept = sum(run["results"]["phase2"] == run["results"]["phase1"] for run in runs)
    if kept == len(runs):
        return "phase 1 kept"
    aside = f"; phase 1 kept: {kept} of {len(runs)} seeds" if kept else ""
    return brief(difference(runs, "phase1", "phase2")) + aside


def percent(shares: Iterable[float]) -> str:
    return f"{100 * fmean(shares):.1f}%"


def chosen(runs: Runs, name: str) -> str:
    """Return a share of the chosen instructions, the mean over seeds."""
    return percent([run["results"]["suitability"][name]["rate"] for run in runs])
