"""Tables letter by letter."""

import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.report import markdown_table, text_table
from ifo_grounding.report.results import by_scene, seeds_table
from ifo_grounding.stats import wilson

ROWS = [
    {"task": "move", "success": wilson(1946, 2000), "steps": 12_000},
    {"task": "pick|out", "success": None, "steps": 7, "extra": 0.5},
]


def test_text_table():
    assert text_table(ROWS) == "\n".join(
        [
            "task                          success   steps  extra",
            "--------  ---------------------------  ------  -----",
            "move      97.3% [96.5, 97.9] (n=2000)  12,000      –",
            "pick|out                            –       7    0.5",
        ]
    )


def test_markdown_table():
    rows = [{"task|\nlevel": row["task"], "success": row["success"]} for row in ROWS]
    assert markdown_table(rows) == "\n".join(
        [
            r"| task\| level | success |",
            "| --- | ---: |",
            "| move | 97.3% [96.5,\u00a097.9] (n=2000) |",
            r"| pick\|out | – |",
        ]
    )


@pytest.mark.parametrize("make", [text_table, markdown_table])
def test_empty_tables_are_refused(make):
    with pytest.raises(UserError, match="at least one row"):
        make([])


def test_intervals_are_not_broken_by_a_browser():
    row = {"success": wilson(5, 10), "speed": "1M [0.9M, 1.1M]", "words": "[one, two, three]"}
    line = markdown_table([row]).splitlines()[-1]
    assert line == "| 50.0% [23.7,\u00a076.3] (n=10) | 1M [0.9M,\u00a01.1M] | [one, two, three] |"


def test_rows_over_seeds_are_of_both_phases_or_of_what_was_measured():
    won, half = by_scene(torch.ones(8, dtype=torch.bool)), by_scene(torch.arange(8) < 4)
    phases = {"phase1": half, "phase2": won, "random": half}
    runs = [
        ("run*", phases),
        ("run*", phases),
        ("r", {"gail": won, "curve": []}),
        ("r", {"bc": won}),
    ]
    lines = seeds_table(runs).splitlines()
    assert lines[0].split() == [
        "runs",
        "seeds",
        "phase1",
        "phase2",
        "gain,",
        "points",
        "gail",
        "bc",
    ]
    assert [line.split()[:2] for line in lines[2:]] == [["run*", "2"], ["r", "1"], ["r", "1"]]
    assert "random" not in lines[0] and lines[3].count("100.0%") == 1
