"""Demonstrations that were recorded elsewhere, through the recipes."""

import re
import shutil

import pytest
import torch

from comparing import assert_same
from ifo_grounding import data
from ifo_grounding.errors import UserError


@pytest.fixture
def demos():
    return data.record_demonstrations("move", 40, seed=7)


def test_recorded_demonstrations_are_learned_from(options, tmp_path, demos):
    from imitate import imitate_truth
    from two_phase import two_phase

    data.save_pictures(demos, tmp_path / "shown")
    given = options(f"recorded={tmp_path / 'shown'}", "demonstrations.n=30", "until=imitate")
    results = two_phase(given)
    learned = data.Demonstrations.load(tmp_path / "run" / "demonstrations")
    assert_same(learned, demos[:30])
    assert learned.tokens.equal(demos.tokens[:30])
    assert not (tmp_path / "run" / "truth").exists()
    assert "labels" not in results and results["phase1"]["rate"]["count"] == 20
    with pytest.raises(UserError, match="hold no true actions"):
        imitate_truth(given)


def test_recordings_that_changed_are_another_run(options, recipes, tmp_path, demos, capsys):
    from record_demonstrations import record

    data.save_pictures(demos[:12], tmp_path / "shown")
    given = options(f"recorded={tmp_path / 'shown'}", "demonstrations.n=10")
    assert record(given)["demonstrations"] == 10
    assert "10 of 12 recorded demonstrations" in capsys.readouterr().out
    assert record(given)["demonstrations"] == 10
    (tmp_path / "shown" / ".DS_Store").write_text("a desktop's")
    assert record(given)["demonstrations"] == 10
    (tmp_path / "shown").rename(tmp_path / "before")
    gone = options(f"recorded={tmp_path / 'shown'}", "demonstrations.n=10")
    assert record(gone)["demonstrations"] == 10  # what was read is kept
    shutil.copytree(tmp_path / "before", tmp_path / "shown")
    said = tmp_path / "shown" / "episodes.jsonl"
    said.write_text(said.read_text().replace("red", "der", 1))
    with pytest.raises(UserError, match=r"held .* files of .* when .* another run="):
        record(given)


@pytest.mark.parametrize("write", [data.Demonstrations.save, data.save_pictures, data.save_lerobot])
@pytest.mark.parametrize("cut", [0, 5])
def test_stops_are_added_where_none_is_shown(options, recipes, tmp_path, demos, write, cut):
    """Where some are shown, the other recordings were cut."""
    from _shared import world_of

    opened = range(cut or len(demos))
    frames = [demos[n]["pixels"][: -1 if n in opened else None] for n in range(len(demos))]
    open_ended = data.Demonstrations.from_arrays(
        frames, demos.sentences(), vocabulary=demos.vocabulary, tile_size=8
    )
    write(open_ended, tmp_path / "shown")
    given = options(f"recorded={tmp_path / 'shown'}", "demonstrations.n=99")
    assert given.demonstrations.n == len(demos)
    read = world_of(given).read(tmp_path / "shown")
    assert read.lengths.equal(demos.lengths - (torch.arange(len(demos)) < cut).long())


@pytest.mark.parametrize(
    ("said", "refused"),
    [
        (["world.tile_size=16"], r"are \[3, 48, 48\], those of the simulator \[3, 96, 96\]"),
        (["recorded=nowhere"], "recorded=nowhere is no folder"),
        (["recorded=."], r"no episodes\.jsonl, as a folder of pictures .* no meta\.json"),
        (["task=pick"], r"is of another task: .* is no sentence of pick; .*say task="),
    ],
)
def test_recorded_demonstrations_have_to_fit(options, recipes, tmp_path, demos, said, refused):
    from record_demonstrations import record

    demos.save(tmp_path / "shown")
    with pytest.raises(UserError, match=refused):
        record(options(f"recorded={tmp_path / 'shown'}", *said))


@pytest.mark.parametrize("changed", ["not", "grey", "jpeg", "scaled"])
def test_colours_that_the_simulator_does_not_show_are_noted(
    options, recipes, tmp_path, demos, changed, capsys
):
    from record_demonstrations import record

    def seen(frames):
        picture = frames.float()
        if changed == "grey":
            picture = picture.mean(1, keepdim=True).expand(frames.shape)
        if changed == "jpeg":  # which loses a little of every colour
            picture = picture + torch.randint(-3, 4, frames.shape)
        return (picture * (0.9 if changed == "scaled" else 1)).clamp(0, 255).byte()

    frames = [seen(demos[n]["pixels"]) for n in range(len(demos))]
    data.Demonstrations.from_arrays(frames, demos.sentences(), vocabulary=demos.vocabulary).save(
        tmp_path / "shown"
    )
    record(options(f"recorded={tmp_path / 'shown'}"))
    noted = re.search(r"note: (\d+)% of the recorded pixels", capsys.readouterr().err)
    assert (noted is None) == (changed == "not")
    assert noted is None or int(noted[1]) > 20


def test_recorded_words_have_to_be_the_worlds(options, tmp_path, demos):
    from record_demonstrations import record

    other = data.Demonstrations.from_episodes([("one", demos[0]["pixels"].numpy(), "go to it")])
    other.save(tmp_path / "shown")
    with pytest.raises(UserError, match="another vocabulary than the world"):
        record(options(f"recorded={tmp_path / 'shown'}"))
