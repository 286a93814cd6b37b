"""Tables of results say what the committed files say."""

import importlib.util
from pathlib import Path

ROOT = Path(__file__).parents[1]


def load_script():
    spec = importlib.util.spec_from_file_location("make_results", ROOT / "docs" / "make_results.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tables_are_up_to_date():
    script = load_script()
    assert script.runs()
    for path, text in script.written().items():
        assert path.read_text() == text, f"{path.name}: run python docs/make_results.py"


def test_every_result_says_where_it_comes_from():
    for run in load_script().runs():
        assert run["command"].startswith("ifo-grounding demo")
        assert run["provenance"]["commit"]
        assert not run["provenance"]["commit"].endswith("+"), "made from files that changed since"
        assert run["options"]["seed"] is not None
        assert run["seconds"] > 0
        assert run["results"]["phase1"]["rate"]["count"] >= 2000
