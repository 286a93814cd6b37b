import csv

import pytest
import torch

from ifo_grounding.errors import UserError
from ifo_grounding.training import Checkpoint, Run


def test_a_stage_is_done_once_per_settings(tmp_path):
    run = Run(tmp_path / "run")
    assert run.stage("train", {"lr": 1}).result is None
    run.stage("train", {"lr": 1}).finish({"loss": 0.5}, [{"step": 1.0}])
    assert run.stage("train", {"lr": 1}).result == {"loss": 0.5}
    assert run.stage("train", {"lr": 2}).result is None
    assert (tmp_path / "run" / "metrics" / "train.json").exists()


def test_a_stage_is_to_be_done_again_when_an_earlier_one_changed(tmp_path):
    run = Run(tmp_path / "run")
    run.stage("record", 1).finish({})
    run.stage("label", "x", needs=["record"]).finish({})
    assert run.stage("label", "x", needs=["record"]).result == {}
    run.stage("record", 2).finish({})
    assert run.stage("label", "x", needs=["record"]).result is None


def test_what_was_made_from_an_earlier_stage_that_changed_is_not_current(tmp_path):
    run = Run(tmp_path / "run")
    assert not run.is_current("imitate")
    run.stage("imitate", 1).finish({})
    run.stage("practise", "x", needs=["imitate", "never"]).finish({})
    run.stage("report", "y", needs=["practise"]).finish({})
    assert run.is_current("practise") and run.is_current("report")
    run.stage("imitate", 2).finish({})
    assert run.is_current("imitate")
    assert not run.is_current("practise") and not run.is_current("report")


def test_what_is_missing_is_named_with_the_recipe_that_makes_it(tmp_path):
    with pytest.raises(UserError, match=r"inverse\.safetensors is missing: run the recipe train_"):
        Run(tmp_path / "run").need("inverse.safetensors", "train_inverse")


def test_a_stage_whose_file_is_gone_is_to_be_done_again(tmp_path):
    run = Run(tmp_path / "run")
    run.stage("imitate", {}).finish({})
    (run / "policy").write_text("weights")
    run.need("policy", "imitate")
    assert run.stage("imitate", {}).result == {}
    (run / "policy").unlink()
    with pytest.raises(UserError, match="run the recipe imitate"):
        run.need("policy", "imitate")
    assert run.stage("imitate", {}).result is None


def test_a_stage_drops_no_checkpoint_of_one_whose_name_begins_like_its_own(tmp_path):
    stage = Run(tmp_path / "run").stage("zero-shot", {})
    for name in ("zero-shot", "zero-shot-3", "zero-shot-jitter", "zero-shot-jitter-0"):
        Checkpoint(tmp_path / "run" / "checkpoints" / f"{name}.pt", "a").save({})
    stage.finish({})
    left = sorted(path.stem for path in (tmp_path / "run" / "checkpoints").iterdir())
    assert left == ["zero-shot-jitter", "zero-shot-jitter-0"]


def test_names_live_under_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path))
    assert Run("mine").folder == tmp_path / "runs" / "mine"
    assert Run(tmp_path / "elsewhere").folder == tmp_path / "elsewhere"


def test_metrics_reach_the_csv_logger_once_also_after_a_kill(tmp_path):
    run = Run(tmp_path / "run")
    stage = run.stage("train", {})
    log = stage.log()
    log({"loss": 3.0}, 10)
    log({"loss": 2.0}, 20)
    stage.checkpoint.parent.mkdir(parents=True)
    stage.checkpoint.touch()  # the run was killed after step 20, its checkpoint is of step 10
    again = run.stage("train", {}).log()
    again({"loss": 2.0}, 20)
    again({"loss": 1.0}, 30)
    (path,) = (tmp_path / "run" / "logs").rglob("loss.csv")
    rows = [(int(row[0]), float(row[1])) for row in csv.reader(path.open()) if row]
    assert rows == [(10, 3.0), (20, 2.0), (30, 1.0)]


def test_an_unknown_logger_is_refused(tmp_path):
    with pytest.raises(UserError, match="unknown logger 'paper'"):
        Run(tmp_path, logger="paper")
    assert Run(tmp_path, logger="none").stage("a", {}).log() is None


def test_a_run_takes_over_what_another_has_finished(tmp_path):
    first = Run(tmp_path / "first")
    first.stage("count", {"to": 3}).finish({"counted": 3})
    (first / "logs").mkdir()
    (first / "network.safetensors").write_bytes(b"weights")
    first.stage("sum", {}).finish({"total": 6})
    (first / "report").mkdir()
    (first / "report" / "index.html").write_text("what the first run measured")
    second = Run(tmp_path / "second")
    second.take_over(first, without=["sum", "other.safetensors"])
    assert not (second / "report").exists()
    assert second.stage("sum", {}).result is None
    assert second.stage("count", {"to": 3}).result == {"counted": 3}
    assert second.stage("count", {"to": 4}).result is None
    assert (second / "network.safetensors").read_bytes() == b"weights"
    assert not (second / "logs").exists()
    second.stage("count", {"to": 4}).finish({"counted": 4})
    second.take_over(first)  # it has begun: nothing is overwritten
    assert second.stage("count", {"to": 4}).result == {"counted": 4}
    with pytest.raises(UserError, match="no finished stages"):
        Run(tmp_path / "third").take_over(Run(tmp_path / "nowhere"))
    (tmp_path / "empty").mkdir()
    Run(tmp_path / "empty").take_over(first)
    assert Run(tmp_path / "empty").begun
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(UserError, match="holds other files"):
        Run(tmp_path / "other").take_over(first)


def test_a_stage_counts_the_time_before_a_kill(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    run = Run(tmp_path / "run")
    stage = run.stage("train", 1)
    for number, seconds in enumerate((20.0, 5.0)):
        checkpoint = Checkpoint(stage.checkpoint.with_stem(f"train-{number}"), "a")
        clock[0] += seconds
        checkpoint.save({})
    clock[0] = 1000.0
    again = Run(tmp_path / "run").stage("train", 1)
    clock[0] = 1002.0
    again.finish({})
    assert run.record("train")["seconds"] == 27.0


def test_a_stage_that_is_done_anew_logs_anew(tmp_path):
    for settings, value in ((1, 0.5), (2, 0.25)):
        stage = Run(tmp_path / "run").stage("train", settings)
        stage.log()({"loss": value}, 10)
        stage.finish({})
    (file,) = (tmp_path / "run" / "logs" / "train").rglob("*.csv")
    assert file.read_text().split() == ["10,0.25"]


def test_a_checkpoint_of_other_settings_does_not_keep_their_log(tmp_path):
    for settings, value in ((1, 0.5), (2, 0.25)):
        stage = Run(tmp_path / "run").stage("train", settings)
        for step in (10, 20)[: 3 - settings]:
            stage.log()({"loss": value}, step)
        stage.checkpoint.parent.mkdir(exist_ok=True)
        torch.save({}, stage.checkpoint)  # and then it is killed
    (file,) = (tmp_path / "run" / "logs" / "train").rglob("*.csv")
    assert file.read_text().split() == ["10,0.25"]


def test_a_name_with_a_folder_is_a_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Run("./name").folder.resolve() == tmp_path / "name"
    assert Run(".").folder.resolve() == tmp_path
    with pytest.raises(UserError, match="needs a name"):
        Run("")


def test_what_is_being_replaced_is_not_taken_for_done(tmp_path):
    run = Run(tmp_path / "run")
    run.stage("count", {"to": 3}).finish({"counted": 3})
    run.stage("count", {"to": 4}).replace()  # and killed before it was done
    assert run.stage("count", {"to": 3}).result is None and not run.is_current("count")


def test_an_interrupted_stage_is_known_to_whatever_it_builds_on(tmp_path):
    run = Run(tmp_path / "run")
    for name, needs in (("label", []), ("imitate", ["label"]), ("judge", []), ("other", [])):
        run.stage(name, {}, needs).finish({})
    practice = run.stage("practise", {}, ["imitate", "judge"])
    practice.begin()
    assert run.unfinished_on("imitate") is None  # nothing is left of it
    Checkpoint(practice.checkpoint.with_stem("practise-0"), "a").save({})
    for name in ("label", "imitate", "judge"):
        assert run.unfinished_on(name) == "practise"
    assert run.unfinished_on("other") is None
    run.stage("imitate", {}, ["label"]).replace()  # as if by hand: it builds on that no more
    assert run.unfinished_on("label") is None
    practice.finish({})
    assert not list((run / "checkpoints").iterdir())
