"""Demonstrations that were recorded elsewhere, through the recipes."""

import pytest

from ifo_grounding.data import Demonstrations, record_demonstrations, save_pictures
from ifo_grounding.errors import UserError
from ifo_grounding.files import write_json


@pytest.fixture
def demos():
    return record_demonstrations("move", 40, seed=7)


@pytest.mark.parametrize("pictures", [False, True])
def test_both_phases_learn_from_recorded_demonstrations(compose, tmp_path, demos, pictures, capsys):
    from label import label
    from references import imitate_truth
    from two_phase import two_phase

    from report import report

    (save_pictures if pictures else Demonstrations.save)(demos, tmp_path / "shown")
    given = [f"recorded={tmp_path / 'shown'}", "demonstrations.n=30"]
    options = compose("two_phase", *given)
    results = two_phase(options)
    learned = Demonstrations.load(tmp_path / "run" / "demonstrations")
    assert len(learned) == 30
    for number in range(30):
        assert learned[number]["pixels"].equal(demos[number]["pixels"])
    assert learned.tokens.equal(demos.tokens[:30])
    assert not (tmp_path / "run" / "truth").exists()
    assert "labels" not in results
    assert results["phase2"]["rate"]["count"] == 50
    assert report(options).exists()
    capsys.readouterr()
    two_phase(compose("two_phase", *given))
    assert "running" not in capsys.readouterr().out
    assert "accuracy" not in label(compose("label", *given))
    with pytest.raises(UserError, match="hold no actions"):
        imitate_truth(options)
    assert (tmp_path / "run" / "stages" / "record_demonstrations.json").exists()


@pytest.mark.parametrize("pictures", [False, True])
def test_stops_that_are_not_shown_are_added(compose, tmp_path, demos, pictures):
    from _worlds import read_recorded

    frames = [demos[number]["pixels"][:-1] for number in range(len(demos))]
    open_ended = Demonstrations.from_arrays(
        frames, demos.sentences(), vocabulary=demos.vocabulary, tile_size=8
    )
    (save_pictures if pictures else Demonstrations.save)(open_ended, tmp_path / "shown")
    read = read_recorded(compose("two_phase", f"recorded={tmp_path / 'shown'}"))
    assert read.lengths.equal(demos.lengths[: len(read)])


def test_a_file_of_results_is_looked_for_by_what_was_recorded(compose, tmp_path, demos):
    """As it will be named, before anything is trained."""
    from study import study

    demos.save(tmp_path / "shown")
    given = [f"recorded={tmp_path / 'shown'}", f"results={tmp_path}"]
    options = compose("study", "demonstrations.n=3000", *given)
    file = tmp_path / f"move-40-{options.network}-seed0.json"
    write_json(file, {"options": {"run": "another"}})
    with pytest.raises(UserError, match="is of the run another"):
        study(options)
    assert not (tmp_path / "run").exists()


def test_what_was_recorded_before_goes_with_its_truth(compose, tmp_path, demos):
    from record_demonstrations import record

    record(compose("record_demonstrations"))
    assert (tmp_path / "run" / "truth").exists()
    demos.save(tmp_path / "shown")
    options = compose(
        "record_demonstrations",
        f"recorded={tmp_path / 'shown'}",
        "demonstrations.n=3000",
        "preset=strong",
    )
    assert options.imitate.prior == 2000
    found = record(options)
    assert found["demonstrations"] == 40
    # Those that there are decide how they are learned from, and stand in the results.
    assert options.demonstrations.n == 40 and options.imitate.prior == 1000
    assert not (tmp_path / "run" / "truth").exists()


@pytest.mark.parametrize(
    ("said", "refused"),
    [
        (["world.tile_size=16"], r"are \[3, 48, 48\], those of the simulator \[3, 96, 96\]"),
        (["references=true"], "recorded demonstrations hold no actions"),
        (["recorded=nowhere"], "recorded=nowhere is no folder"),
        (["task=pick"], r"is of another task: .* is no sentence of pick; .*say task="),
    ],
)
def test_recorded_demonstrations_have_to_fit(compose, tmp_path, demos, said, refused):
    from two_phase import two_phase

    demos.save(tmp_path / "shown")
    with pytest.raises(UserError, match=refused):
        two_phase(compose("two_phase", f"recorded={tmp_path / 'shown'}", *said))


def test_recorded_words_have_to_be_the_worlds(compose, tmp_path, demos):
    from record_demonstrations import record

    other = Demonstrations.from_episodes([("one", demos[0]["pixels"].numpy(), "go to it")])
    other.save(tmp_path / "shown")
    with pytest.raises(UserError, match="another vocabulary than the world"):
        record(compose("record_demonstrations", f"recorded={tmp_path / 'shown'}"))
