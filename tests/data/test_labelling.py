"""Labels: an inverse model that is right gives a buffer that is right."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from ifo_grounding import data
from ifo_grounding.errors import UserError
from ifo_grounding.networks import make_inverse


class WatchTheArm(nn.Module):
    """An inverse model written by hand: the arm's cell is the one with a white corner."""

    def __init__(self, logit: float = 9.0) -> None:
        super().__init__()
        self.logit = nn.Parameter(torch.tensor(logit))
        self.noise = nn.Dropout(0.9)

    def arm(self, pixels: Tensor) -> Tensor:
        return (pixels[:, :, ::8, ::8] == 255).all(1).flatten(1).float().argmax(1)

    def forward(self, pixels: Tensor, after: Tensor) -> Tensor:
        moved = self.arm(after) - self.arm(pixels)
        same = (pixels == after).flatten(1).all(1)
        action = torch.where(same, 5, 4)
        for number, distance in enumerate((-6, 1, 6, -1)):
            action = torch.where(moved == distance, number, action)
        return self.noise(nn.functional.one_hot(action, 6) * self.logit)


@pytest.fixture
def inverse() -> TensorDictModule:
    return TensorDictModule(WatchTheArm(), ["pixels", ("next", "pixels")], ["logits"])


@pytest.mark.parametrize("task", ["move-udlr", "pick"])
def test_labels_are_what_the_expert_did(task, inverse):
    demos, truth = data.record_demonstrations(task, 60, keep_truth=True)
    buffer, report = data.label_demonstrations(demos, inverse, batch_size=100, progress=False)
    assert torch.equal(report.actions, truth.actions)
    assert torch.equal(report.counts, truth.actions.long().bincount(minlength=6))
    assert report.counts[5] == 60
    assert len(buffer) == demos.transitions


def test_labels_read_from_tiles_are_those_read_from_pixels(monkeypatch):
    demos = data.record_demonstrations("pick-out", 40)
    model = make_inverse(demos, seed=0)
    network = type(model.module)
    read = []
    from_tiles = network.from_tiles
    monkeypatch.setattr(
        network, "from_tiles", lambda self, *tiles: read.append(1) or from_tiles(self, *tiles)
    )
    report = data.label_demonstrations(demos, model, batch_size=100, progress=False).report
    assert len(read) == -(-demos.transitions // 100)
    monkeypatch.setattr(network, "reads_tiles", lambda self, *sizes: False)
    plain = data.label_demonstrations(demos, model, batch_size=100, progress=False).report
    assert len(report.actions.unique()) > 1
    assert torch.equal(report.actions, plain.actions)
    torch.testing.assert_close(report.confidence, plain.confidence)


@pytest.mark.parametrize("preset", ["strong", "paper"])
def test_a_model_reads_the_images_that_it_names(preset):
    demos = data.record_demonstrations("move", 20)

    def labels(**names):
        model = make_inverse(demos, preset, seed=0, **names)
        return data.label_demonstrations(demos, model, progress=False), model

    (_, usual), _ = labels()
    (_, renamed), _ = labels(in_keys=["before", "after"])
    assert torch.equal(renamed.actions, usual.actions)
    (_, swapped), model = labels(in_keys=[("next", "pixels"), "pixels"])
    frame = demos.locate()[1]
    with torch.no_grad():
        said = model(pixels=demos.frames(frame), next_pixels=demos.frames(frame + 1)).argmax(-1)
    assert torch.equal(said, swapped.actions.long())


def test_samples_are_the_demonstrations_own_transitions(inverse):
    demos, truth = data.record_demonstrations("pick", 20, keep_truth=True)
    buffer, _ = data.label_demonstrations(demos, inverse, progress=False)
    row = 0
    for episode, one in enumerate(demos):
        steps = len(one) - 1
        entries = buffer[row : row + steps]
        assert torch.equal(entries["pixels"], one["pixels"][:-1])
        assert (entries["instruction"] == demos.instructions[episode]).all()
        assert torch.equal(entries["action"], truth.actions[row : row + steps].long())
        assert entries["final"].squeeze(-1).tolist() == [False] * (steps - 1) + [True]
        assert entries["final"].shape == (steps, 1)
        row += steps
    sample = buffer.sample(64)
    assert sample["instruction"].dtype == sample["action"].dtype == torch.int64
    assert torch.equal(buffer[sample["index"]]["pixels"], sample["pixels"])
    assert torch.equal(buffer[sample["index"]]["instruction"], sample["instruction"])


def test_the_report_says_how_sure_the_model_was(inverse):
    demos = data.record_demonstrations("move", 50)
    inverse.module.logit.data.fill_(1.0)
    _, report = data.label_demonstrations(demos, inverse, progress=False)
    expected = torch.tensor([1.0, 0, 0, 0, 0, 0]).softmax(0)[0]
    torch.testing.assert_close(report.confidence, expected.expand(demos.transitions))

    actions = torch.tensor([2, 0, 2, 2], dtype=torch.uint8)
    report = data.LabelReport(actions, torch.tensor([0.5, 0.75, 1.0, 0.75]), 4)
    rows = report.summary()
    assert [row["count"] for row in rows] == [1, 0, 3, 0]
    assert rows[1] == {"action": 1, "count": 0}
    assert rows[2] == {
        "action": 2, "count": 3, "mean": 0.75, "min": 0.5, "p01": 0.5, "p10": 0.5, "median": 0.75
    }  # fmt: skip


@pytest.mark.parametrize(("n_actions", "dtype"), [(256, torch.uint8), (300, torch.int32)])
def test_a_saved_report_of_any_number_of_actions_makes_the_buffer_again(tmp_path, n_actions, dtype):
    demos = data.record_demonstrations("move", 3)
    last = torch.arange(n_actions) == n_actions - 1
    sure = TensorDictModule(lambda x: last.float().expand(len(x), -1), ["pixels"], ["logits"])
    _, report = data.label_demonstrations(demos, sure, progress=False)
    report.save(tmp_path / "labels")
    loaded = data.LabelReport.load(tmp_path / "labels")
    assert torch.equal(loaded.actions, report.actions) and loaded.actions.dtype == dtype
    assert torch.equal(loaded.confidence, report.confidence)
    assert loaded.counts[-1] == demos.transitions and len(loaded.counts) == n_actions
    buffer = data.labelled_buffer(demos, loaded.actions)
    assert (buffer[:]["action"] == n_actions - 1).all()
    with pytest.raises(UserError, match="were they made for these demonstrations"):
        data.labelled_buffer(demos[:2], loaded.actions)


def test_bad_input_is_refused(inverse):
    demos = data.record_demonstrations("move", 5)
    for label in (0.9, -1):
        with pytest.raises(UserError, match="numbers of actions"):
            data.labelled_buffer(demos, torch.full((demos.transitions,), label))
    with pytest.raises(UserError, match="batch_size must be"):
        data.label_demonstrations(demos, inverse, batch_size=0)
    frame, token = torch.zeros(1, 3, 8, 8, dtype=torch.uint8), torch.ones(1, 1).long()
    alone = data.Demonstrations(data.FrameCodec((3, 8, 8)), frame, torch.tensor([1]), token)
    with pytest.raises(UserError, match="nothing to label"):
        data.label_demonstrations(alone, inverse)
    flat = TensorDictModule(lambda pixels: pixels.float().flatten(2), ["pixels"], ["logits"])
    with pytest.raises(UserError, match=r"wrote \[\d+, 3, 2304\] at 'logits'"):
        data.label_demonstrations(demos, flat, progress=False)
    inverse.module.logit.data.fill_(torch.nan)
    with pytest.raises(UserError, match="not all finite"):
        data.label_demonstrations(demos, inverse, progress=False)
