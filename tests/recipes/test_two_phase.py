import json
import math
import re
from pathlib import Path

import pytest
import torch

from ifo_grounding import networks
from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json, write_json
from ifo_grounding.report import results_table
from ifo_grounding.report.results import by_scene
from pretended_gpu import pretended_gpu

PHASES = {f"policy-phase{phase}.safetensors" for phase in (1, 2)}


@pytest.mark.parametrize(
    ("task", "preset", "extra"),
    [
        ("move", "film", []),
        ("pick-udlr", "paper", ["self_examine.pairs=24"]),
        (
            "move-udlr",
            "strong",
            ["world.split=train", "evaluate.split=zero-shot", "self_examine.recombine=true"],
        ),
        (
            "pick-out",
            "film",
            [
                "self_examine.kind=both",
                "self_examine.reward_steps=1",
                "self_examine.recombine=true",  # which also says what makes no sense
            ],
        ),
    ],
)
def test_both_phases_run_through_and_write_a_report(compose, tmp_path, task, preset, extra):
    from two_phase import two_phase

    from report import report

    options = compose("two_phase", f"task={task}", f"preset={preset}", *extra)
    results = two_phase(options)
    run = tmp_path / "run"

    assert {path.name for path in run.glob("policy*")} == PHASES
    assert results["phase1"]["scenes"] == results["phase2"]["scenes"]
    assert results["phase1"]["rate"]["count"] == 50
    assert results["gain"]["count"] == 50
    assert ("trained" in results) == (options.evaluate.split == "zero-shot")
    assert 0 < results["labels"]["rate"]["rate"] <= 1
    table = results_table(results)
    assert "phase 2 - phase 1" in table
    assert "suitable rate" in table

    page = report(options)
    text = re.sub("base64,[A-Za-z0-9+/=]+", "", page.read_text())  # which may say anything
    assert "Self-examination" in text
    assert "http" not in text
    audit = json.loads((run / "metrics" / "self_examine.json").read_text())
    assert [row["step"] for row in audit] == [1, 2]
    assert all("success" in row for row in audit)
    if options.self_examine.reward_steps:
        assert "agreement" in audit[-1]

    # Its networks can be given away.
    from share import share

    shared = tmp_path / "shared"
    folders = share(compose("share", f"task={task}", f"preset={preset}", f"to={shared}"))
    assert {folder.name for folder in folders} >= {"policy", "inverse", "instruction"}
    policy = networks.from_pretrained(shared / "policy", kind="policy")
    trained = networks.load(run / "policy-phase2.safetensors")
    assert all(map(torch.equal, policy.state_dict().values(), trained.state_dict().values()))
    assert policy.vocabulary.decode(torch.tensor([[1]])) == ["circle"]
    assert f"| Task | {task} |" in (shared / "policy" / "README.md").read_text()

    # A second call finds everything done.
    stamps = {path: path.stat().st_mtime_ns for path in run.rglob("*.safetensors")}
    assert two_phase(options) == results
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())


@pytest.mark.parametrize(
    ("task", "preset", "extra"),
    [
        ("move", "strong", []),
        pytest.param("pick", "paper", ["self_examine.kind=both"], marks=pytest.mark.slow),
    ],
)
def test_both_phases_run_on_a_gpu(compose, task, preset, extra):
    from two_phase import two_phase

    few = [
        f"{net}.batch_size=16" for net in ("inverse", "imitate", "instruction", "reward", "goal")
    ]
    few += [
        "demonstrations.n=60",
        "transitions.n=1000",
        "instruction.steps=5",
        "goal.steps=5",
        "self_examine.num_envs=8",
        "self_examine.select_episodes=8",
        "evaluate.episodes=10",
        "evaluate.states=20",
        "evaluate.audit_episodes=10",
    ]
    options = compose("two_phase", f"task={task}", f"preset={preset}", "device=cuda", *few, *extra)
    with pretended_gpu():
        results = two_phase(options)
    assert results["phase2"]["rate"]["count"] == 10
    assert results["phase1"]["scenes"] == results["phase2"]["scenes"]


def test_a_study_compares_phase_2_with_its_controls(compose, tmp_path):
    from controls import matched_steps
    from study import study

    given = ("study", f"results={tmp_path / 'results'}", "imitate.lr=1e-4")
    options = compose(*given)
    alone = study(compose(*given, "controls.clone=false"))
    assert "continued" in alone and "cloned" not in alone
    results = study(options)
    names = ("phase1", "phase2", "continued", "cloned")
    assert "imitation continued, success (control)" in results_table(results)
    assert len({results[name]["scenes"] for name in names}) == 1
    assert all(len(bytes.fromhex(results[name]["outcomes"])) == 7 for name in names)  # 50 scenes
    section = options.self_examine
    frames = section.iterations * section.num_envs * section.steps
    rehearsed = frames / section.minibatch * section.epochs * 256
    samples = frames * (2 * section.epochs + 1 / 3) + rehearsed
    assert matched_steps(options) == round(samples / options.imitate.batch_size)
    once = compose("study", "self_examine.algorithm=reinforce", "self_examine.rehearsal=0")
    assert matched_steps(once) == round(frames * (2 + 1 / 3) / once.imitate.batch_size)
    for control in ("continue_imitation", "clone_accepted"):
        history = json.loads((tmp_path / "run" / "metrics" / f"{control}.json").read_text())
        assert 0 <= history[-1]["selection_return"] <= 1
    # An audit in which every episode succeeds knows no area under a curve.
    from study import audit

    metrics = tmp_path / "run" / "metrics" / "self_examine.json"
    write_json(metrics, [{"step": 1.0, "return_auc": math.nan, "success": 1.0, "other": 2.0}])
    assert audit(options) == [{"step": 1.0, "success": 1.0}]
    [path] = (tmp_path / "results").glob("*.json")
    assert path.name == "move-300-strong-seed0.json"
    assert json.loads(path.read_text())["results"]["cloned"]["outcomes"]


def test_a_changed_option_redoes_what_depends_on_it(compose, tmp_path):
    from imitate import imitate
    from label import label
    from record_demonstrations import record
    from train_inverse import train_inverse
    from collect_transitions import collect  # isort: skip

    options = compose("imitate")
    for stage in (collect, train_inverse, record, label, imitate):
        stage(options)
    first = networks.load(tmp_path / "run" / "policy-phase1.safetensors").state_dict()
    inverse = (tmp_path / "run" / "inverse.safetensors").stat().st_mtime_ns
    changed = compose("imitate", "imitate.steps=25")
    for stage in (collect, train_inverse, record, label, imitate):
        stage(changed)
    second = networks.load(tmp_path / "run" / "policy-phase1.safetensors").state_dict()
    assert (tmp_path / "run" / "inverse.safetensors").stat().st_mtime_ns == inverse
    assert any(not torch.equal(weight, second[name]) for name, weight in first.items())


def test_options_replace_values_of_every_network(compose, tmp_path):
    from record_demonstrations import record
    from train_inverse import train_inverse
    from collect_transitions import collect  # isort: skip

    def features(*options):
        given = compose("train_inverse", *options)
        for stage in (record, collect, train_inverse):
            stage(given)
        inverse = networks.load(tmp_path / "run" / "inverse.safetensors")
        return inverse.network_config.config.features

    assert features() == 32
    assert features("networks.features=16") == 16
    assert features() == 32
    with pytest.raises(UserError, match="preset 'paper' alone"):
        features("networks.sentence_rate=0.5")


def test_a_stage_without_what_it_needs_says_what_to_run(compose):
    from imitate import imitate

    with pytest.raises(UserError, match="run the recipe record_demonstrations"):
        imitate(compose("imitate"))
    from evaluate import evaluate

    with pytest.raises(UserError, match="run the recipe imitate"):
        evaluate(compose("evaluate"))


def test_every_recipe_has_options_that_begin_with_its_command(recipes):
    for script in recipes.glob("[!_]*.py"):
        first = (recipes / "conf" / f"{script.stem}.yaml").read_text().splitlines()[0]
        assert first.startswith(f"# python recipes/{script.name}"), script.name
        assert Path(script).read_text().startswith('"""')


@pytest.mark.parametrize(
    ("losses", "number"),
    [((1.0,), 0), ((1.0, 0.95), 0), ((1.0, 0.7, 0.65), 1), ((1.0, 0.7, 0.6), 2)],
)
def test_the_last_beginning_goes_on_only_where_it_is_clearly_better(recipes, losses, number):
    from train_instruction import clearly_best

    class Tried:
        def __init__(self, loss):
            self.loss = loss

        def try_out(self):
            return self.loss

    tried = [Tried(loss) for loss in losses]
    assert clearly_best(tried) is tried[number]


def test_the_instruction_module_tries_the_policys_roles_and_sees_fresh_states(compose):
    from _shared import load_demonstrations, load_network, open_run
    from collect_transitions import collect
    from imitate import imitate
    from label import label
    from record_demonstrations import record
    from train_instruction import fresh_states, losses, train_instruction
    from train_inverse import train_inverse

    asked = ("instruction.fresh_states=301", "instruction.trials=3")
    options = compose("train_instruction", "task=pick", *asked)
    for stage in (record, collect, train_inverse, label, imitate):
        stage(options)
    assert train_instruction(options)["beginning"] in (0.0, 1.0, 2.0)

    run = open_run(options)
    policy = load_network(run, "policy-phase1.safetensors", "imitate", options)
    tried = losses(options, run, load_demonstrations(run), None)
    theirs, *own = (
        next(part for part in each.modules() if isinstance(part, networks.WordMaps))
        for each in (policy, *tried)
    )
    for part, last in (("about_form.weight", True), ("role.weight", False)):
        weight = theirs.state_dict()[part]
        kept = [torch.equal(words.state_dict()[part], weight) for words in own]
        assert kept == [True, True, last]
    heads = [each.network.module.head[1].weight for each in tried]
    assert not torch.equal(heads[0], heads[1])

    assert fresh_states(options, 301) is None
    states = fresh_states(options, 300)
    assert states.shape == (301, 3, 48, 48)
    assert len(states.flatten(1).unique(dim=0)) == 301
    assert torch.equal(states, fresh_states(options, 300))


@pytest.mark.parametrize(("preset", "schedule"), [("paper", "constant"), ("film", "cosine")])
def test_the_papers_learning_rate_does_not_decay(compose, preset, schedule):
    from _learning import fit_config

    options = compose("two_phase", f"preset={preset}")
    for section in ("inverse", "imitate", "instruction", "reward", "goal"):
        assert fit_config(options[section]).schedule == schedule


def test_a_report_leaves_out_what_is_not_there_or_of_another_phase_1(compose, tmp_path):
    from imitate import imitate
    from two_phase import train_phases

    from report import report

    train_phases(compose("two_phase"))
    options = compose("report", "imitate.steps=30", "evaluate.states=0")
    imitate(options)
    page = report(options).read_text()
    assert "Episodes of phase 1" in page
    assert "Imitation" in page
    assert "Self-examination" not in page and "Chosen instructions" not in page


@pytest.mark.parametrize("mode", ["greedy", "sampled"])
def test_changed_scenes_are_shown_of_the_policy_that_was_measured(compose, mode):
    """Actions that were drawn are not drawn again: what they solved may fail in the picture."""
    from _shared import open_run
    from _worlds import open_world
    from two_phase import train_phases

    from report import episode_pictures

    options = compose("two_phase")
    train_phases(options)
    outcomes = {"phase1": torch.zeros(50), "phase2": torch.ones(50)}
    results = {
        phase: {"mode": mode, **by_scene(solved.bool())} for phase, solved in outcomes.items()
    }
    found = episode_pictures(open_run(options), open_world(options), results)
    assert "Episodes of phase 2" in found
    assert ("Solved by phase 2 alone" in found) == (mode == "greedy")


def test_nothing_is_shared_or_measured_of_another_phase_1(compose, tmp_path):
    from evaluate import evaluate
    from imitate import imitate
    from share import share
    from train_inverse import train_inverse
    from two_phase import two_phase

    two_phase(compose("two_phase"))
    imitate(compose("imitate", "imitate.steps=30"))
    shared = {folder.name for folder in share(compose("share", f"to={tmp_path / 'shared'}"))}
    assert shared == {"policy", "inverse"}
    given = networks.from_pretrained(tmp_path / "shared" / "policy").state_dict()
    trained = networks.load(tmp_path / "run" / "policy-phase1.safetensors").state_dict()
    assert all(torch.equal(weight, trained[name]) for name, weight in given.items())
    assert "success" not in (tmp_path / "shared" / "policy" / "README.md").read_text()
    train_inverse(compose("train_inverse", "inverse.steps=30"))
    for recipe in (share, evaluate):
        with pytest.raises(UserError, match="run the recipe imitate again"):
            recipe(compose("share", f"to={tmp_path / 'shared'}"))


def test_instructions_chosen_by_other_options_are_evaluated_anew(compose):
    from evaluate import evaluate
    from two_phase import train_phases

    train_phases(compose("two_phase", "practise=false"))
    served = []
    for threshold in (0.01, 0.9999):
        options = compose("evaluate", f"instruction.threshold={threshold}")
        served.append(evaluate(options)["suitability"]["served"]["rate"])
    assert served[0] > served[1]


def test_the_log_begins_with_the_trials(compose, tmp_path):
    from imitate import imitate
    from label import label
    from record_demonstrations import record
    from train_inverse import train_inverse
    from collect_transitions import collect  # isort: skip

    options = compose("imitate", "logger=csv")
    for stage in (record, collect, train_inverse, label, imitate):
        stage(options)
    (file,) = (tmp_path / "run" / "logs" / "imitate").rglob("loss_imitation.csv")
    assert [line.split(",")[0] for line in file.read_text().split()] == ["10", "20"]


def test_the_better_half_of_the_beginnings_is_tried_for_longer(compose, tmp_path):
    import imitate
    from collect_transitions import collect
    from label import label
    from record_demonstrations import record
    from train_inverse import train_inverse

    tried = ["imitate.trials=5", "imitate.trial_steps=10", "imitate.steps=40"]
    options = compose("imitate", *tried, "imitate.trial_halvings=1")
    for stage in (record, collect, train_inverse, label):
        stage(options)
    asked = []

    class Watched(imitate.Beginning):
        def try_out(self, times=1):
            loss = super().try_out(times)
            asked.append((times, self.number, loss))
            return loss

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(imitate, "Beginning", Watched)
        found = imitate.imitate(options)
    first = sorted((loss, number) for times, number, loss in asked if times == 1)
    second = sorted((loss, number) for times, number, loss in asked if times == 2)
    assert len(first) == 5 and len(asked) == 8
    assert {number for _, number in second} == {number for _, number in first[:3]}
    assert found["beginning"] == second[0][1]
    history = read_json(tmp_path / "run" / "metrics" / "imitate.json")
    assert [each["step"] for each in history] == [10, 20, 30, 40]
    assert history[1]["loss_imitation"] == second[0][0]


def test_a_card_says_what_was_measured_last(compose, tmp_path):
    from evaluate import evaluate
    from imitate import imitate
    from share import share
    from two_phase import two_phase

    two_phase(compose("two_phase", "phase2=false"))
    longer = ["phase2=false", "imitate.steps=30"]
    imitate(compose("imitate", *longer))
    measured = evaluate(compose("evaluate", *longer, "evaluate.episodes=40"))
    share(compose("share", f"to={tmp_path / 'shared'}"))
    card = (tmp_path / "shared" / "policy" / "README.md").read_text()
    count = measured["phase1"]["rate"]["count"]
    assert count == 40 and f"(n={count})" in card and "Command" not in card


def test_practice_on_stale_judges_is_refused_and_said_to_be_left_out(compose, tmp_path, capsys):
    from evaluate import evaluate
    from imitate import imitate
    from self_examine import examine
    from two_phase import two_phase

    two_phase(compose("two_phase"))
    longer = "imitate.steps=30"
    imitate(compose("imitate", longer))
    with pytest.raises(UserError, match="run the recipe train_instruction again"):
        examine(compose("self_examine", longer))
    capsys.readouterr()
    assert "phase2" not in evaluate(compose("evaluate", longer))
    assert "phase2 builds on what was made anew since, and is left out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("imitate.lr=-1", "lr must be above 0, got -1"),
        ("device=gpu", "device=gpu is none: use cpu, cuda or cuda:0"),
        ("self_examine.gamma=2", r"gamma must be within 0..1, got 2"),
        ("self_examine.clip=-1", "clip must be above 0"),
        ("self_examine.entropy=-1", "entropy must not be negative"),
        ("evaluate.mode=foo", "evaluate.mode"),
        ("evaluate.stream=foo", "evaluate.stream"),
        ("evaluate.episodes=0", "evaluate.episodes must be at least 1, got 0"),
        ("evaluate.states=-1", "evaluate.states must be 0 or more"),
        ("transitions.stop_probability=2", "transitions.stop_probability must be within 0..1"),
        ("demonstrations.n=0", "demonstrations.n must be at least 1"),
        ("imitate.trial_halvings=-1", "trial_halvings must be 0 or more"),
        ("imitate.trials=0", "imitate.trials must be at least 1"),
        ("instruction.trial_steps=0", "instruction.trial_steps must be at least 1"),
        ("imitate.held_out=2", r"imitate.held_out must be a share, in \[0, 1\)"),
        ("self_examine.select_episodes=0", "select_episodes must be at least 1"),
        ("threads=-1", "threads must be at least 1"),
        ("device=meta", "device=meta is none: use cpu, cuda or cuda:0"),
        ("self_examine.kind=foo", "unknown self_examine.kind 'foo'"),
        ("self_examine.form=foo", "unknown self_examine.form 'foo'"),
        ("self_examine.pairs=0", "self_examine.pairs must be at least 1"),
        ("self_examine.reward_lr=0.0", "self_examine.reward_lr must be above 0"),
        ("instruction.unlabelled=foo", "unknown instruction.unlabelled 'foo'"),
        ("instruction.near=1.0", r"instruction.near must be a share, in \[0, 1\)"),
        ("goal.near=-0.5", r"goal.near must be a share, in \[0, 1\)"),
        ("goal.removal_rate=few", r"goal.removal_rate must be a share, in \[0, 1\), got few"),
        ("networks.dropout=2.0", "dropout must lie in"),
        ("world.layout.objects=[1]", r"objects must be \(fewest, most\)"),
        ("simulator=babyai", "a level of BabyAI is chosen by world=babyai"),
    ],
)
def test_impossible_options_are_refused_before_a_run_begins(compose, tmp_path, wrong, said):
    from two_phase import two_phase

    with pytest.raises(UserError, match=said):
        two_phase(compose("two_phase", wrong))
    assert not (tmp_path / "run").exists()


def test_a_stage_says_what_it_found_line_by_line(compose, capsys):
    from _shared import tell

    found = {"grad_norm": 0.87186746, "samples_per_second": 11786.6, "to": "x", "auc": math.nan}
    tell({"taken": [1200, 3.0], **found})
    _, _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in lines] == ["3", "0.8719", "11,787", "x", "–"]
    assert lines[0].split() == ["taken", "1,200,", "3"]


def test_a_call_that_was_refused_does_not_keep_a_run_from_its_base(compose, tmp_path):
    from _shared import open_run
    from label import label
    from record_demonstrations import record

    record(compose("record_demonstrations", f"run={tmp_path / 'first'}"))
    with pytest.raises(UserError, match="is missing"):
        label(compose("label"))
    assert (tmp_path / "run" / "machines.json").exists()
    run = open_run(compose("label", f"base={tmp_path / 'first'}"))
    assert run.record("record_demonstrations")
