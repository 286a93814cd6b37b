"""The page holds everything, escapes everything, and needs nothing."""

import base64
import json
import re

import numpy as np
import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.report import Captioned, training_curves, write_report
from ifo_grounding.stats import paired_difference, wilson
from outline import read


@pytest.fixture
def page(tmp_path):
    """Write a page with every kind of content."""
    picture = np.zeros((3, 48, 48), np.uint8)
    figure = training_curves([{"step": 0, "loss": 2.0}, {"step": 1, "loss": 1.0}])
    gif = base64.b64decode("R0lGODlhAQABAIAAAAAAAP///ywAAAAAAQABAAACAUwAOw==")
    results = {
        "Phase 1": wilson(1900, 2000),
        "Difference": paired_difference([0, 1], [1, 1]),
        "By task": [{"task": "move", "success": wilson(9, 10)}, {"task": "<b>", "success": None}],
        "Settings": {"seed": 0, "rate": 8e-4, "path": torch.tensor([1, 2]), "nan": float("nan")},
        "Remark": "5 < 6 & so on",
    }
    pictures = {
        "Curve": figure,
        "Curve!": figure,
        "Cases": [Captioned(picture, "move <here>", note="missing")],
        "No cases": [],
        "Clip" * 99: gif,
    }
    return write_report(tmp_path / "report", results, pictures, title="A & B \ud800", summary="<i>")


def test_it_is_one_page_without_any_outside_source(page):
    outline = read(page)
    assert outline.sources
    for source in outline.sources:
        assert re.match(r"data:image/(png|gif);base64,[A-Za-z0-9+/=]+$", source)
    text = page.read_text()
    assert not re.search(r"https?://|<script|@import|url\(", text)


def test_every_content_is_there_and_escaped(page):
    outline = read(page)
    tables, shown = ["By task", "Settings", "Remark"], ["Curve!", "Cases", "No cases", "Clip" * 99]
    assert outline.headings == ["Curve", *shown, *tables]  # one picture is shown, the rest folded
    texts = outline.texts
    for text in ("A & B ?", "95.0%", "[94.0, 95.9] (n=2000)", "+50.0 points", "5 < 6 & so on"):
        assert text in texts, text
    for text in ("<b>", "<i>", "move <here>", "missing", "None.", "0.0008", "–"):
        assert text in texts, text


def test_files_beside_the_page(page):
    folder = page.parent
    results = json.loads((folder / "results.json").read_text())
    assert results["Phase 1"]["successes"] == 1900
    assert results["By task"][0]["success"]["count"] == 10
    assert results["Settings"] == {"seed": 0, "rate": 8e-4, "path": [1, 2], "nan": None}
    names = sorted(path.name for path in (folder / "pictures").iterdir())
    assert names == ["01-curve.png", "02-curve.png", "03-cases.png", f"05-{('clip' * 20)[:77]}.gif"]


def test_refusals(tmp_path):
    with pytest.raises(UserError, match="PNG, GIF or JPEG"):
        write_report(tmp_path, {}, {"Clip": b"text"})
