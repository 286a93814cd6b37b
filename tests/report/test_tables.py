"""Tables letter by letter."""

import pytest

from ifo_grounding.errors import UserError
from ifo_grounding.report import markdown_table, text_table
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
