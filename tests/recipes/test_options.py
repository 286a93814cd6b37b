"""What is refused before a run begins, and with which options a finished run is looked at."""

import pytest
import torch

from ifo_grounding.cli import run_recipe
from ifo_grounding.data import Demonstrations, first_frame_buffer, record_demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json
from pretended_gpu import pretended_gpu

STAGES_OF_PHASE_1 = (
    "record_demonstrations",
    "collect_transitions",
    "train_inverse",
    "label",
    "imitate",
)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("device=cuda:7", "no GPU|CUDA"),
        ("logger=wandb", r"pip install 'ifo-grounding\[wandb\]'"),
        ("task=mov", "unknown task 'mov'"),
        ("self_examine.algorithm=sac", "unknown algorithm 'sac'"),
        ("instruction.threshold=1.5", "threshold is a probability"),
        ("imitate.batch_size=0", "batch_size"),
        ("world.layout.size=2", "size must be 3..16"),
        ("world.layout.objects=[a,b]", "objects"),
        ("self_examine.pairs=2.5", "self_examine.pairs must be a whole number, got 2.5"),
        ("self_examine.lr=nan", "lr must be a number, got nan"),
        ("self_examine.lr=inf", "lr must be finite"),
        ("networks.features=2.5", "features must be a whole number"),
        ("threads=1.5", "threads must be a whole number"),
        ("self_examine.value_warmup=30", "the policy would never learn"),
    ],
)
def test_what_a_later_stage_would_refuse_is_refused_first(
    compose, recipes, tmp_path, monkeypatch, wrong, said
):
    from two_phase import two_phase

    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=said):
        two_phase(compose("two_phase", wrong))
    assert not (tmp_path / "run").exists()


def test_what_a_run_was_made_with_counts_but_for_what_is_named(compose):
    from _options import merged
    from _shared import plain

    made = plain(compose("two_phase", "preset=film", "demonstrations.n=100", "seed=3"))
    given = compose("evaluate", "evaluate.episodes=70", "instruction.choose=random", "threads=2")
    options = merged(given, made, ["run", "evaluate.episodes", "instruction.choose", "threads"])
    assert (options.network, options.demonstrations.n, options.seed) == ("film", 100, 3)
    assert (options.evaluate.episodes, options.instruction.choose) == (70, "random")
    assert options.evaluate.states == given.evaluate.states
    assert (options.threads, options.run) == (2, given.run)
    assert options.imitate == compose("two_phase", "preset=film").imitate
    assert merged(given, made, ["budget"]).evaluate == given.evaluate

    for named in ("preset", "demonstrations.n", "seed"):
        with pytest.raises(UserError, match="was made with"):
            merged(given, made, [named])
    assert merged(given, made, ["task", "world"]).task == "move"
    del made["references"], made["evaluate"]["split"]  # of a run older than these options
    older = merged(given, made, [])
    assert (older.references, older.evaluate.split) == (False, "all")


def test_few_demonstrations_are_imitated_in_small_batches_unless_told(compose):
    def imitate(*said):
        options = compose("two_phase", *said).imitate
        return options.batch_size, options.get("prior", 0)

    assert imitate("demonstrations.n=999") == (64, 1000)
    assert imitate("demonstrations.n=1000") == (256, 2000)
    assert imitate("demonstrations.n=999", "imitate.batch_size=32") == (32, 1000)
    assert imitate("demonstrations.n=999", "preset=paper") == (128, 0)


def test_a_run_may_be_called_by_a_number(compose):
    from _shared import open_run

    assert open_run(compose("two_phase", "run=7")).folder.name == "7"


def test_a_report_says_what_the_run_was_made_with(compose, tmp_path, capsys):
    from two_phase import train_phases

    train_phases(
        compose("two_phase", "preset=film", "demonstrations.n=100", "seed=3", "phase2=false")
    )
    run_recipe("report", [f"run={tmp_path / 'run'}", "evaluate.episodes=20"])
    page = (tmp_path / "run" / "report" / "index.html").read_text()
    assert "preset film" in page
    assert "100 demonstrations, seed 3, 20 evaluation scenes" in page
    with pytest.raises(SystemExit):
        run_recipe("evaluate", [f"run={tmp_path / 'run'}", "task=pick"])
    assert "was made with task=move, not pick" in capsys.readouterr().err


def test_scenes_of_pairs_that_were_named_are_no_zero_shot(compose, capsys):
    from evaluate import evaluate
    from two_phase import train_phases

    train_phases(compose("two_phase", "demonstrations.n=100", "phase2=false"))
    evaluate(compose("evaluate", "evaluate.split=zero-shot", "demonstrations.n=100"))
    assert "no zero-shot success" in capsys.readouterr().err


def test_a_run_made_stage_by_stage_is_looked_at_as_it_was_made(compose, tmp_path, capsys):
    from evaluate import evaluate
    from imitate import imitate
    from record_demonstrations import record

    pick = ["task=pick", "demonstrations.n=90"]
    for stage in STAGES_OF_PHASE_1:
        steps = ["imitate.steps=30"] if stage == "imitate" else []
        run_recipe(stage, [*pick, *steps, "budget=tiny", f"run={tmp_path / 'run'}"])
    looked_at = [f"run={tmp_path / 'run'}"]
    run_recipe("evaluate", [*looked_at, "evaluate.episodes=20"])
    written = read_json(tmp_path / "run" / "options.json")
    assert (written["task"], written["demonstrations"]["n"]) == ("pick", 90)
    assert written["imitate"]["steps"] == 30
    run_recipe("share", [*looked_at, f"to={tmp_path / 'shared'}"])
    card = (tmp_path / "shared" / "policy" / "README.md").read_text()
    assert "pick" in card and "90" in card
    for stage in (imitate, evaluate):
        with pytest.raises(UserError, match="was made with task=pick, not move"):
            stage(compose("imitate", "demonstrations.n=90"))
    record(compose("record_demonstrations"))  # the first stage of another run in its place
    assert read_json(tmp_path / "run" / "options.json")["task"] == "move"


def test_damaged_options_are_said_to_be(compose, tmp_path):
    from _shared import made_with, open_run

    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "options.json").write_text("3")
    with pytest.raises(UserError, match=r"options\.json is damaged"):
        made_with(open_run(compose()))


@pytest.mark.parametrize("share", [0.999, 0.001])
def test_some_demonstrations_are_held_out_and_some_are_not(compose, tmp_path, share):
    from _shared import open_run
    from imitate import split_transitions

    demos = record_demonstrations("move", 30, seed=0)
    actions = torch.zeros(demos.transitions, dtype=torch.int64)
    with pytest.raises(UserError, match=f"held_out={share} of 30 demonstrations holds out"):
        split_transitions(demos, actions, share)
    with pytest.raises(UserError, match=r"actions for .* transitions"):
        split_transitions(demos, actions[1:], 0.5)
    options = compose("imitate", "demonstrations.n=30", f"imitate.held_out={share}")
    with pytest.raises(UserError, match=f"held_out={share} of 30 demonstrations holds out"):
        open_run(options)
    assert not (tmp_path / "run").exists()


def test_any_stage_of_a_new_run_may_begin_with_what_another_made(compose, tmp_path):
    from label import label
    from two_phase import train_phases

    train_phases(compose("two_phase", "phase2=false"))
    base = f"base={tmp_path / 'run'}"
    assert label(compose("label", base, f"run={tmp_path / 'other'}"))["confidence"]
    refused = compose("two_phase", base, f"run={tmp_path / 'second'}", "self_examine.kind=foo")
    with pytest.raises(UserError, match=r"unknown self_examine\.kind"):
        train_phases(refused)
    assert not (tmp_path / "second").exists()
    with pytest.raises(UserError, match="holds no finished stages"):
        label(compose("label", f"base={tmp_path / 'none'}", f"run={tmp_path / 'third'}"))


@pytest.mark.parametrize(
    ("added", "said"),
    [
        ("+imitat.schedule=constant", "unknown option 'imitat.schedule' (did you mean 'imitate'?)"),
        ("+imitate.iterations=5", "unknown option 'imitate.iterations'"),
        ("+self_examine.hidden=5", "unknown option 'self_examine.hidden'"),
        ("+imitate.grad_clip=-1.0", "grad_clip must be above 0"),
        ("+imitate.validate_every=abc", "validate_every must be a whole number, got 'abc'"),
        ("+imitate.trials=3", "Could not append to config. An item is already at"),
        ("run=/dev/null/run", "Not a directory"),
        ("~imitate", "option 'imitate' is needed"),
    ],
)
def test_what_nothing_would_read_is_not_added(recipes, capsys, added, said):
    with pytest.raises(SystemExit) as stopped:
        run_recipe("two_phase", ["budget=tiny", added])
    assert stopped.value.code == 2 and said in capsys.readouterr().err


@pytest.mark.parametrize("preset", ["strong", "film", "paper"])
def test_the_policy_learns_in_the_smallest_budget_too(compose, preset):
    section = compose("two_phase", f"preset={preset}", "budget=tiny").self_examine
    assert section.value_warmup < section.iterations
    usual = {"strong": 3, "film": 3, "paper": 2}
    usually = compose("two_phase", f"preset={preset}", "budget=full").self_examine
    assert usually.value_warmup == usual[preset]


def test_a_run_says_where_each_stage_was_done(compose, monkeypatch):
    import _shared
    from record_demonstrations import record

    def on(machine):
        monkeypatch.setattr(_shared, "machine_of", lambda device: machine)

    options = compose("two_phase", "demonstrations.n=20")
    on("a laptop")
    record(options)
    stage = _shared.open_stage(options, "imitate", ["imitate"], needs=[])
    stage.checkpoint.parent.mkdir(parents=True, exist_ok=True)
    stage.checkpoint.write_text("begun")
    on("a GPU")
    record(options)  # done before
    _shared.open_stage(options, "imitate", ["imitate"], needs=[])
    run = _shared.open_run(options)
    done = {"record_demonstrations": ["a laptop"], "imitate": ["a laptop", "a GPU"]}
    assert _shared.machines(run) == done
    stage.checkpoint.unlink()  # it begins anew
    _shared.open_stage(options, "imitate", ["imitate"], needs=[])
    assert _shared.machines(run) == {**done, "imitate": ["a GPU"]}


def test_a_call_that_replaced_nothing_leaves_the_options_that_a_run_was_made_with(compose):
    import _shared
    from record_demonstrations import record

    options = compose("two_phase", "demonstrations.n=20")
    record(options)
    run = _shared.open_run(options)
    options.demonstrations.n = 30
    _shared.open_stage(options, "record_demonstrations", ["demonstrations"], needs=[])  # and killed
    assert _shared.made_with(run)["demonstrations"]["n"] == 20
    record(options)
    assert _shared.made_with(run)["demonstrations"]["n"] == 30


def test_the_small_file_of_another_run_is_not_replaced(compose, tmp_path):
    from _results import keep_result

    options = compose("two_phase", f"results={tmp_path / 'small files'}")
    keep_result(options, {"options": {"run": options.run}, "results": 1})
    keep_result(options, {"options": {"run": options.run}, "results": 2})
    options.run = "another"
    with pytest.raises(UserError, match="tell them apart with variant="):
        keep_result(options, {"options": {"run": "another"}, "results": 3})
    options.variant = "mine"
    keep_result(options, {"options": {"run": "another"}, "results": 3})
    found = [read_json(file)["results"] for file in sorted((tmp_path / "small files").iterdir())]
    assert sorted(found) == [2, 3]


def test_what_an_interrupted_stage_builds_on_is_not_replaced(compose):
    import _shared
    from record_demonstrations import record

    options = compose("two_phase", "demonstrations.n=20")
    record(options)
    stage = _shared.open_stage(options, "imitate", ["imitate"], needs=["record_demonstrations"])
    stage.checkpoint.write_text("begun")
    options.demonstrations.n = 30
    before = stage.run.record("record_demonstrations")
    with pytest.raises(UserError, match="but imitate was interrupted, which builds on it as it is"):
        record(options)
    assert stage.run.record("record_demonstrations") == before
    stage.checkpoint.unlink()
    record(options)
    assert stage.run.record("record_demonstrations") != before


def test_frames_of_tiles_are_decoded_on_a_gpu(recipes):
    from _learning import decode_on
    from controls import Both
    from tensordict import TensorDict

    demos = record_demonstrations("move", 3, seed=0)
    with pretended_gpu():
        buffer = first_frame_buffer(demos)
        decode_on("cpu", buffer)
        assert not buffer.sample(2)["pixels"].is_cuda
        decode_on("cuda", buffer)
        assert buffer.sample(2)["pixels"].is_cuda
        pixels = demos.first_frames([0]).flatten(0, -4)
        raw = Demonstrations.from_arrays([torch.rand(2, 3, 9, 9).mul(255).byte()], ["go up"])
        plain = first_frame_buffer(raw)  # whose table of frames may be larger than a GPU
        decode_on("cuda", plain)
        assert not plain.sample(2)["pixels"].is_cuda
        decode_on("cuda", Both(buffer, TensorDict({"pixels": pixels}, [1])))


def test_how_instructions_are_chosen_decides_nothing_of_what_chooses(compose):
    from _shared import OF_CHOICE, open_stage

    def judge(*said):
        options = compose("two_phase", *said)
        return open_stage(options, "train_instruction", ["instruction"], [], without=OF_CHOICE)

    judge().finish({"loss": 0.5})
    assert judge("instruction.threshold=0.4", "instruction.choose=random").result == {"loss": 0.5}
    assert judge("instruction.negatives=9").result is None
    options = compose("two_phase", "instruction.threshold=0.4")
    practice = ["self_examine", "instruction"]
    open_stage(compose("two_phase"), "self_examine", practice, []).finish({})
    assert open_stage(options, "self_examine", practice, []).result is None


def test_a_goal_judge_from_before_there_were_near_negatives_is_one_without_any(compose):
    from _shared import open_run, plain
    from train_goal import train_goal

    options = compose("two_phase", "goal.init_from_policy=false")
    section = plain(options.goal)
    del section["near"]
    earlier = {key: plain(options[key]) for key in ("task", "seed", "network", "world")}
    open_run(options).stage("record_demonstrations", {}).finish({})
    stage = open_run(options).stage(
        "train_goal", {**earlier, "goal": section}, ["record_demonstrations"]
    )
    stage.finish({"loss_goal": 0.5})
    assert train_goal(options) == {"loss_goal": 0.5}
