"""Records of runs in which something else stands: each is refused in one line, by its file."""

import copy
import json

import pytest

from ifo_grounding.errors import UserError
from ifo_grounding.files import read_record, write_record
from ifo_grounding.training import Run

OTHERS = (None, -1, "x", [], {}, 1e308, [1], {"a": 1}, True, float("inf"), "9" * 5000)
RESULT = {
    "phase1": {"rate": {"rate": 0.5, "low": 0.4, "high": 0.6, "count": 20}, "mode": "greedy"},
    "suitability": {"reliability": [[0.1, {"rate": 0.2}], [0.9, {"rate": 0.8}]]},
    "changes": (1, None),
}
"""Nested as what an evaluation finds."""
HISTORY = [{"step": 1.0, "loss": 0.5, "success": None}, {"step": 2.0, "loss": float("nan")}]


def changed(content):
    """Return copies of nested JSON, in each of which another value stands in one place."""
    found = [copy.deepcopy(other) for other in OTHERS]
    items = content.items() if isinstance(content, dict) else enumerate(content)
    for place, part in items if isinstance(content, (dict, list)) else ():
        for other in changed(part) if isinstance(part, (dict, list)) else OTHERS:
            found.append(copy.deepcopy(content))
            found[-1][place] = other
        if isinstance(content, dict):
            found.append({name: value for name, value in content.items() if name != place})
    return [other for other in found if other != content]


@pytest.fixture
def run(tmp_path):
    run = Run(tmp_path / "run", logger="none")
    run.stage("evaluate").finish(RESULT, HISTORY)
    return run


def test_a_record_is_read_as_it_was_written(run):
    assert run.record("evaluate")["result"] == {**json.loads(json.dumps(RESULT))}
    assert run.metrics("evaluate") == [HISTORY[0], {"step": 2.0, "loss": None}]
    assert run.metrics("imitate") == []


def test_a_record_with_any_other_value_is_refused(run):
    path = run / "stages/evaluate.json"
    wrong = changed(json.loads(path.read_text()))
    assert len(wrong) > 150
    for content in wrong:
        path.write_text(json.dumps(content))
        with pytest.raises(UserError, match=r"evaluate\.json") as refused:
            run.records()
        assert "\n" not in str(refused.value) and len(str(refused.value)) < 400


def test_metrics_are_rows_of_numbers(run):
    path = run / "metrics/evaluate.json"
    for content in changed(json.loads(path.read_text())):
        path.write_text(json.dumps(content))
        said = ""
        try:
            rows = run.metrics("evaluate")
        except UserError as error:
            said = str(error)
        if said:
            assert "evaluate.json" in said and "\n" not in said
        else:  # another number is as good
            assert all(isinstance(row["step"], (int, float)) for row in rows)


def test_a_record_of_an_interrupted_hand_is_refused(tmp_path):
    write_record(tmp_path / "result.json", {"command": "demo", "seconds": 1.0})
    text = (tmp_path / "result.json").read_text()
    assert read_record(tmp_path / "result.json") == {"command": "demo", "seconds": 1.0}
    for other in (text.replace("demo", "demos"), text[: len(text) // 2], "", "[]", "{}", "3"):
        (tmp_path / "result.json").write_text(other)
        with pytest.raises(UserError, match=r"result\.json"):
            read_record(tmp_path / "result.json")
