import contextlib
import csv
import multiprocessing
import types

import pytest

from ifo_grounding.errors import UserError
from ifo_grounding.machine import processor
from ifo_grounding.training import Checkpoint, Run

OPTIONS = {"task": "move", "threads": 1, "imitate": {"steps": 900, "lr": 1e-5, "held_out": None}}


def test_a_run_has_a_name_or_a_path_and_a_known_logger(tmp_path, monkeypatch):
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert Run("mine").folder == tmp_path / "runs" / "mine"
    assert Run(tmp_path / "elsewhere").folder == tmp_path / "elsewhere"
    assert Run("./name").folder.resolve() == tmp_path / "name"
    assert Run(".").folder.resolve() == tmp_path
    with pytest.raises(UserError, match="needs a name"):
        Run("")
    with pytest.raises(UserError, match="unknown logger 'paper'"):
        Run(tmp_path, logger="paper")
    assert Run(tmp_path, logger="none").stage("a").log() is None


@pytest.mark.parametrize(
    ("changed", "free", "error"),
    [
        ({}, [], None),
        ({"steps": 10}, ["threads"], r"made with imitate\.steps=900, not 10: leave it out"),
        ({"held_out": 0.1}, [], r"imitate\.held_out=null, not 0\.1: leave it out, or give another"),
        ({"steps": 10}, ["imitate.step"], r"imitate\.steps=900"),
        ({"steps": 10}, ["imitate.steps"], None),
        ({"steps": 10, "lr": 1.0}, ["imitate"], None),
        ({"new": 3}, [], r"made by another version, without imitate\.new"),
        ({"new": None}, [], None),
        ({"new": 3}, ["imitate"], None),
    ],
)
def test_other_options_are_another_run(tmp_path, changed, free, error):
    run = Run(tmp_path / "run")
    assert run.options() is None
    run.begin(OPTIONS)
    asked = {**OPTIONS, "imitate": {**OPTIONS["imitate"], **changed}}
    with pytest.raises(UserError, match=error) if error else contextlib.nullcontext():
        run.begin(asked, free)
    assert run.options() == OPTIONS


def test_an_option_that_is_gone_is_of_another_version(tmp_path):
    run = Run(tmp_path / "run")
    run.begin(OPTIONS)
    run.begin({**OPTIONS, "imitate": {"steps": 900, "lr": 1e-5}})  # held_out was None
    with pytest.raises(UserError, match=r"another version, with imitate\.steps"):
        run.begin({**OPTIONS, "imitate": {"lr": 1e-5}})


@pytest.mark.parametrize(
    "content",
    [
        *(b"\xff\xfe\x00", b"a: [1", b"- a\n", b"x: ${nothing}\n", b""),
        *(b"seed: 1\nseed: 2\n", b"a: !!bool maybe\n"),
    ],
)
def test_damaged_options_are_one_line(tmp_path, content):
    (tmp_path / "config.yaml").write_bytes(content)
    with pytest.raises(UserError, match=r"config\.yaml is damaged|another version") as error:
        Run(tmp_path).begin(OPTIONS)
    assert "\n" not in str(error.value)


def test_options_are_read_anew_where_their_file_has_changed(tmp_path):
    run = Run(tmp_path)
    (run / "config.yaml").write_text("lr: 1e-3\nlevels: [a]\n")
    found = run.options()
    assert found == {"lr": 0.001, "levels": ["a"]}
    found["levels"].append("b")
    assert run.options() == {"lr": 0.001, "levels": ["a"]}  # what one asks for is its own
    (run / "config.yaml").write_text("lr: 2e-3\nlevels: [a]\n")
    assert run.options() == {"lr": 0.002, "levels": ["a"]}


def test_a_stage_is_done_when_its_record_is_there(tmp_path):
    run = Run(tmp_path / "run")
    assert run.stage("train").result is None and run.record("train") == {}
    assert run.stage("train").finish({"loss": 0.5}, [{"step": 1.0}]) == {"loss": 0.5}
    assert run.stage("train").result == {"loss": 0.5}
    assert run.record("train")["machine"] == processor()
    assert (run / "metrics" / "train.json").exists()
    run.stage("train").finish({"loss": 0.5}, machine="a GPU")
    assert run.record("train")["machine"] == "a GPU"


def test_checkpoints_go_with_the_stage_that_left_them_alone(tmp_path):
    run = Run(tmp_path / "run")
    stage, other = run.stage("imitate"), run.stage("imitate-more")
    for killed in (False, True):  # between the record and the removal
        for path in (stage.checkpoint, stage.trial(12), other.checkpoint):
            Checkpoint(path, {}).save({})
        run.stage("imitate") if killed else stage.finish({})
        assert list((run / "checkpoints").rglob("*.pt")) == [other.checkpoint]


def test_a_stage_counts_the_time_before_a_kill(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    run = Run(tmp_path / "run")
    for number, seconds in enumerate((20.0, 5.0)):
        checkpoint = Checkpoint(run.stage("train").trial(number), {})
        clock[0] += seconds
        checkpoint.save({})
    clock[0] = 1000.0  # killed, continued, and killed again
    checkpoint.load()
    clock[0] += 3.0
    checkpoint.save({})
    clock[0] = 2000.0
    again = run.stage("train")
    clock[0] += 2.0
    again.finish({})
    assert run.record("train")["seconds"] == 20 + 5 + 3 + 2


def test_what_is_missing_is_named_with_the_recipe_that_makes_it_anew(tmp_path):
    run = Run(tmp_path / "run")
    run.stage("imitate").finish({})
    (run / "policy").write_text("weights")
    run.need("policy", "imitate")
    assert run.stage("imitate").result == {}
    (run / "policy").unlink()
    with pytest.raises(UserError, match="policy is missing: run the recipe imitate"):
        run.need("policy", "imitate")
    assert run.stage("imitate").result is None


@pytest.mark.parametrize("logger", ["csv", "tensorboard"])
def test_metrics_are_logged_once_also_after_a_kill(tmp_path, logger):
    run = Run(tmp_path / "run", logger)
    log = run.stage("train").log()
    log({"loss": 3.0}, 10)
    log({"loss": 2.0, "reward/loss": 1.0}, 20)

    def killed():
        yield "loss", 1.5
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # a step is rather cut short than logged twice
        log(types.SimpleNamespace(items=killed), 25)
    again = run.stage("train").log()  # its checkpoint was of step 10
    again({"loss": 2.0, "reward/loss": 1.0}, 20)
    again({"loss": 1.5, "reward/loss": 1.0}, 25)
    again({"loss": 1.0}, 30)
    del log, again
    found, folder = {}, run / "logs" / "train"
    if logger == "csv":
        for path in folder.rglob("*.csv"):
            key = str(path.relative_to(folder / "scalars").with_suffix(""))
            with path.open() as file:
                found[key] = [int(row[0]) for row in csv.reader(file)]
    else:
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        events = EventAccumulator(str(folder)).Reload()
        for key in events.Tags()["scalars"]:
            found[key] = [event.step for event in events.Scalars(key)]
    assert found == {"train/loss": [10, 20, 25, 30], "train/reward/loss": [20]}


def test_wandb_itself_takes_the_metrics_of_a_stage(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="make test-oldest and test-newest install it")
    monkeypatch.setenv("WANDB_MODE", "offline")
    Run(tmp_path / "run", "wandb").stage("imitate").log()({"loss": 1.0}, 10)
    assert wandb.run.summary["imitate/loss"] == 1.0
    wandb.finish()
    assert list((tmp_path / "run" / "logs").rglob("*.wandb"))


@pytest.fixture
def first(tmp_path):
    """A run of two finished stages."""
    run = Run(tmp_path / "first")
    run.begin(OPTIONS)
    for name in ("imitate", "self_examine", "evaluate_ours"):
        run.stage(name).finish({"of": name}, [])
        Checkpoint(run / "checkpoints" / f"{name}.pt", {}).save({})
    for name in ("logs/a.csv", "report/index.html", "policy.safetensors", ".lock"):
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).write_text("of the first run")
    return run


def test_a_run_takes_over_what_another_has_finished_into_a_folder_of_none(tmp_path, first):
    second = Run(tmp_path / "second")
    with second.lock():
        second.take_over(first, without=["self_examine", "evaluate_*", "other.safetensors"])
    taken = {str(path.relative_to(second.folder)) for path in second.folder.rglob("[!.]*.*")}
    assert taken == {"stages/imitate.json", "metrics/imitate.json", "policy.safetensors"}
    assert second.options() is None
    second.begin({**OPTIONS, "seed": 1})
    second.stage("imitate").finish({"of": "second"})
    second.take_over(first)  # it has begun: nothing is overwritten
    assert second.stage("imitate").result == {"of": "second"}
    with pytest.raises(UserError, match="no finished stages"):
        Run(tmp_path / "third").take_over(Run(tmp_path / "nowhere"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(UserError, match="holds other files"):
        Run(tmp_path / "other").take_over(first)


def test_a_take_over_that_was_killed_goes_on(tmp_path, first, monkeypatch):
    second, left = Run(tmp_path / "second"), [2]
    replace = type(tmp_path).replace

    def killed(self, target):
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt
        return replace(self, target)

    monkeypatch.setattr(type(tmp_path), "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        second.take_over(first)
    monkeypatch.undo()
    second.take_over(first)
    assert second.stage("self_examine").result == {"of": "self_examine"}
    assert (second / "policy.safetensors").exists() and not (second / ".taken").exists()


def hold(folder, held, let_go):
    with Run(folder).lock():
        held.set()
        let_go.wait(60)


def test_one_process_at_a_time_works_on_a_run(tmp_path):
    folder = tmp_path / "run"
    (folder / "stages").mkdir(parents=True)
    fork = multiprocessing.get_context("fork")
    held, let_go = fork.Event(), fork.Event()
    other = fork.Process(target=hold, args=(folder, held, let_go), daemon=True)
    other.start()
    assert held.wait(60)
    (folder / "stages" / ".imitate.json.1a2b3c4d.tmp").touch()  # it is writing it just now
    with pytest.raises(UserError, match=rf"process {other.pid} on \S+ since 2"), Run(folder).lock():
        pass
    assert len(list((folder / "stages").iterdir())) == 1
    with Run(tmp_path / "own").lock():  # another container has processes of the same number
        (folder / ".lock").write_bytes((tmp_path / "own" / ".lock").read_bytes())
    with pytest.raises(UserError, match="in use by process"), Run(folder).lock():
        pass
    other.kill()
    other.join()
    with Run(folder).lock():
        assert not list((folder / "stages").iterdir())
        with Run(folder).lock():  # once more by the same process
            pass


def test_what_is_not_of_a_run_stays(tmp_path):
    others = [".notes.tmp", ".draft.txt.bak.tmp", "stages/.mine.tmp", "src/.a.12345678.tmp"]
    ours = [".policy.pt.1a2b3c4d.tmp", ".labels.1a2b3c4d.old", "stages/.a.json.1a2b3c4d.tmp"]
    for name in (*others, *ours):
        (tmp_path / name).mkdir(parents=True)
    with Run(tmp_path).lock():
        left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob(".*.*")}
    assert left == set(others)


def test_a_file_system_without_locks_gets_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr("fcntl.flock", lambda *_: (_ for _ in ()).throw(OSError("not supported")))
    with pytest.warns(UserWarning, match="has no lock .*not supported"), Run(tmp_path).lock():
        pass


def test_a_run_of_which_nothing_came_leaves_nothing(tmp_path, first):
    run = Run(tmp_path / "run")
    run.begin(OPTIONS)
    for each in (run, first):
        each.drop_if_empty()
        assert each.folder.exists() == (each is first)


def test_a_run_begins_in_a_folder_of_its_own(tmp_path):
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "codes.npy").touch()
    with pytest.raises(UserError, match="holds other files and no run"):
        Run(tmp_path / "recordings").begin({"n": 1})
