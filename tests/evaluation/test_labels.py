"""Label accuracy against counts made by hand."""

import json

import pytest
import torch

from ifo_grounding.data import LabelReport, record_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import label_accuracy


def test_accuracy_by_hand():
    truth = torch.tensor([0, 0, 0, 0, 1, 1, 4, 4, 4, 5])
    labels = torch.tensor([0, 0, 0, 1, 1, 1, 4, 5, 5, 5])
    accuracy = label_accuracy(labels, truth)
    assert (accuracy.rate.successes, accuracy.rate.count) == (7, 10)
    assert accuracy.per_action["U"].rate == 0.75
    assert accuracy.per_action["R"].rate == 1.0
    assert accuracy.per_action["P"].rate == pytest.approx(1 / 3)
    assert accuracy.worst == "P"
    assert accuracy.per_action["D"].count == 0  # does not occur, and is not the worst
    assert json.loads(json.dumps(accuracy.as_dict(), allow_nan=False))["worst"] == "P"
    assert str(accuracy).startswith("70.0% [")
    assert "worst P: 33.3%" in str(accuracy)


def test_a_report_of_labels_against_the_truth_of_a_recording():
    demos, truth = record_demonstrations("pick", 20, keep_truth=True)
    accuracy = label_accuracy(LabelReport(truth.actions, torch.ones(len(truth.actions)), 6), truth)
    assert accuracy.rate.rate == 1.0 and accuracy.rate.count == demos.transitions


@pytest.mark.parametrize(
    ("labels", "truth", "message"),
    [
        ([0, 1], [0], "one action per transition"),
        ([6], [0], r"0\.\.5"),
    ],
)
def test_refusals(labels, truth, message):
    with pytest.raises(UserError, match=message):
        label_accuracy(torch.tensor(labels), torch.tensor(truth))
