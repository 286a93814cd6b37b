"""Tables of results say what the committed files say."""

import re
from pathlib import Path

import make_results
import make_tables
import pages

from ifo_grounding.files import read_json
from ifo_grounding.stats import wilson

ROOT = Path(__file__).parents[1]


def test_every_table_of_the_pages_is_what_the_scripts_write():
    tables = make_results.tables()
    shown = set()
    for page in pages.pages():
        text = page.read_text()
        marks = {found["name"] for found in pages.TABLE.finditer(text)}
        assert marks <= set(tables), f"{page.name} shows tables that no script writes"
        assert pages.renewed(text, tables) == text, f"{page.name}: run python docs/make_results.py"
        shown |= marks
    assert shown == set(tables)


def test_every_result_says_where_it_comes_from():
    folders = ("babyai", "few", "study", "tables")
    found = [read_json(file) for of in folders for file in (ROOT / "results" / of).glob("*.json")]
    assert len(found) > 200
    for run in found:
        assert run["command"].startswith("ifo-grounding ")
        assert re.fullmatch(r"[0-9a-f]{12}", run["provenance"]["commit"]), "files had changed since"
        assert run["options"]["seed"] is not None
        assert run["seconds"] > 0
        assert run["results"]["phase1"]["rate"]["count"] >= 2000


def test_a_page_keeps_what_is_not_its_table():
    text = "a\n<!-- x -->\nold\n<!-- /x -->\nb\n<!-- y -->\nkept\n<!-- /y -->\n<!-- x y -->"
    assert pages.renewed(text, {"x": "new"}) == text.replace("old", "new")


def test_gains_of_the_paper_have_newcombes_interval():
    gain = make_tables.gain_of_paper(wilson(48, 80), wilson(56, 70))
    assert gain == "+20.0 [+5.2, +33.4]"  # 0.0524 and 0.3339 in his table II, method 10
