"""Both phases through the recipes: what they make, what is made once, what is refused."""

import json
import re

import pytest
import torch

from ifo_grounding import networks
from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json
from ifo_grounding.report import results_table
from ifo_grounding.report.results import by_scene
from pretended_gpu import pretended_gpu


@pytest.mark.parametrize(
    ("task", "preset", "extra"),
    [
        ("pick-udlr", "paper", ["self_examine.pairs=24", "controls.run=true"]),
        ("move-udlr", "strong", ["world.split=train", "evaluate.split=zero-shot"]),
    ],
)
def test_both_phases_run_through_and_write_a_report(options, tmp_path, task, preset, extra):
    from share import share
    from two_phase import two_phase

    from report import report

    given = options(f"task={task}", f"preset={preset}", f"results={tmp_path / 'kept'}", *extra)
    results = two_phase(given)
    run = tmp_path / "run"
    phases = {f"policy-phase{phase}.safetensors" for phase in (1, 2)}
    assert phases <= {path.name for path in run.glob("policy*")}
    assert results["phase1"]["scenes"] == results["phase2"]["scenes"]
    assert results["phase1"]["rate"]["count"] == results["gain"]["count"] == 50
    assert ("trained" in results) == (given.evaluate.split == "zero-shot")
    assert ("continued" in results) == given.controls.run
    assert 0 < results["labels"]["rate"]["rate"] <= 1
    table = results_table(results)
    assert "phase 2 - phase 1" in table and "suitable rate" in table
    (file,) = (tmp_path / "kept").glob("*.json")
    assert file.name == f"{task}-60-{preset}-seed0.json"
    kept = read_json(file)
    assert kept["results"] == results == read_json(run / "result.json")["results"]
    assert kept["options"]["preset"] == preset and kept["machines"]["imitate"]

    page = report(given).read_text()
    text = re.sub("base64,[A-Za-z0-9+/=]+", "", page)  # which may say anything
    assert "Self-examination" in text and "http" not in text
    audit = json.loads((run / "metrics" / "self_examine.json").read_text())
    assert [row["step"] for row in audit] == [1, 2]
    assert all("success" in row and "suitable" in row for row in audit)
    assert ("held_out_accuracy" in audit[-1]) == (preset == "paper")

    shared = tmp_path / "shared"
    folders = share(options(f"to={shared}"))
    assert {folder.name for folder in folders} >= {"policy", "inverse", "instruction"}
    policy = networks.from_pretrained(shared / "policy", kind="policy")
    trained = networks.load(run / "policy-phase2.safetensors")
    assert all(map(torch.equal, policy.state_dict().values(), trained.state_dict().values()))
    assert policy.vocabulary.decode(torch.tensor([[1]])) == ["circle"]
    assert f"| Task | {task} |" in (shared / "policy" / "README.md").read_text()

    # A second call finds everything done.
    stamps = {path: path.stat().st_mtime_ns for path in run.rglob("*.safetensors")}
    assert two_phase(given) == results
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())


@pytest.mark.parametrize("preset", ["strong", pytest.param("paper", marks=pytest.mark.slow)])
def test_both_phases_run_on_a_gpu(options, preset):
    from two_phase import two_phase

    sections = ("inverse", "imitate", "instruction", "reward", "goal")
    few = [f"{section}.batch_size=16" for section in sections]
    few += ["instruction.steps=5", "goal.steps=5", "self_examine.num_envs=8"]
    few += ["self_examine.select_episodes=8", "evaluate.audit_episodes=10"]
    few += ["evaluate.episodes=10", "evaluate.states=20", "device=cuda"]
    with pretended_gpu():
        results = two_phase(options(f"preset={preset}", *few))
    assert results["phase2"]["rate"]["count"] == 10
    assert results["phase1"]["scenes"] == results["phase2"]["scenes"]


def test_until_ends_after_a_stage_and_the_run_goes_on(options, tmp_path):
    from two_phase import two_phase

    first = two_phase(options("until=imitate"))
    assert "phase2" not in first and "suitability" not in first
    stages = {path.stem for path in (tmp_path / "run" / "stages").glob("*.json")}
    assert "imitate" in stages and "train_instruction" not in stages
    both = two_phase(options())
    assert both["phase1"]["rate"] == first["phase1"]["rate"] and "phase2" in both


def test_another_option_is_refused_before_anything_is_replaced(options, tmp_path, phase_1):
    from imitate import imitate

    phase_1(options())
    weights = (tmp_path / "run" / "policy-phase1.safetensors").read_bytes()
    with pytest.raises(UserError, match=r"made with imitate\.steps=20, not 30.*another run="):
        imitate(options("imitate.steps=30"))
    assert (tmp_path / "run" / "policy-phase1.safetensors").read_bytes() == weights


def test_a_new_run_takes_over_the_phase_1_of_another(options, tmp_path, capsys, phase_1):
    from two_phase import two_phase

    phase_1(options("self_examine.iterations=1"))
    base = f"base={tmp_path / 'run'}"
    capsys.readouterr()
    two_phase(options(base, "self_examine.lr=1e-3", run="second"))
    assert "imitate: done before" in capsys.readouterr().out
    files = [tmp_path / run / "policy-phase1.safetensors" for run in ("run", "second")]
    assert files[0].read_bytes() == files[1].read_bytes()
    with pytest.raises(UserError, match=r"made with imitate\.steps=20, not 30"):
        two_phase(options(base, "imitate.steps=30", run="third"))
    assert not (tmp_path / "third" / "policy-phase1.safetensors").exists()
    with pytest.raises(UserError, match="no finished stages"):
        two_phase(options(f"base={tmp_path / 'none'}", run="fourth"))


def test_options_replace_values_of_every_network(options, tmp_path, phase_1):
    phase_1(options("networks.features=16"), until="train_inverse")
    inverse = networks.load(tmp_path / "run" / "inverse.safetensors")
    assert inverse.network_config.config.features == 16
    with pytest.raises(UserError, match="sentence_rate"):
        phase_1(options("networks.sentence_rate=0.5", run="second"), until="train_inverse")


def test_a_stage_without_what_it_needs_says_what_to_run(options):
    from evaluate import evaluate
    from imitate import imitate

    with pytest.raises(UserError, match="run the recipe record_demonstrations"):
        imitate(options())
    with pytest.raises(UserError, match="run the recipe imitate"):
        evaluate(options())


def test_the_instruction_classifier_tries_the_policys_roles_and_sees_fresh_states(options, phase_1):
    from _shared import load_demonstrations, load_network, open_run
    from train_instruction import fresh_states, losses

    given = options("task=pick", "instruction.fresh_states=301", "instruction.trials=3")
    phase_1(given)
    run = open_run(given)
    policy = load_network(run, "policy-phase1.safetensors", "imitate", given)
    tried = losses(given, run, load_demonstrations(run), None)
    theirs, *own = (
        next(part for part in each.modules() if isinstance(part, networks.WordMaps))
        for each in (policy, *tried)
    )
    for part, last in (("about_form.weight", True), ("role.weight", False)):
        weight = theirs.state_dict()[part]
        assert [torch.equal(words.state_dict()[part], weight) for words in own] == [
            True,
            True,
            last,
        ]
    heads = [each.network.module.head[1].weight for each in tried]
    assert not torch.equal(heads[0], heads[1])
    assert fresh_states(given, 301) is None
    states = fresh_states(given, 300)
    assert len(states) == len(states.flatten(1).unique(dim=0)) == 301


@pytest.mark.parametrize("mode", ["greedy", "sampled"])
def test_changed_scenes_are_shown_of_the_policy_that_was_measured(options, mode, phase_1):
    """Actions that were drawn are not drawn again: what they solved may fail in the picture."""
    from _shared import open_run

    from report import episode_pictures

    given = options()
    phase_1(given)
    run = open_run(given)
    (run / "policy-phase2.safetensors").write_bytes(
        (run / "policy-phase1.safetensors").read_bytes()
    )
    outcomes = {"phase1": torch.zeros(50), "phase2": torch.ones(50)}
    results = {
        phase: {"mode": mode, **by_scene(solved.bool())} for phase, solved in outcomes.items()
    }
    found = episode_pictures(run, given, results)
    assert "Episodes of phase 2" in found
    assert ("Solved by phase 2 alone" in found) == (mode == "greedy")


def test_what_is_measured_otherwise_is_measured_anew(options, phase_1):
    from evaluate import evaluate

    phase_1(options())
    assert evaluate(options())["phase1"]["rate"]["count"] == 50
    again = evaluate(options("evaluate.episodes=40", "evaluate.mode=greedy"))
    assert again["phase1"]["rate"]["count"] == 40 and "sampled" not in again["phase1"]


def test_scenes_of_pairs_that_were_named_are_no_zero_shot(options, capsys, phase_1):
    from evaluate import evaluate

    phase_1(options())
    evaluate(options("evaluate.split=zero-shot"))
    assert "no zero-shot success" in capsys.readouterr().err


def test_imitation_goes_on_for_as_many_samples_as_phase_2_takes(options):
    from controls import matched_steps

    given = options()
    section = given.self_examine
    frames = section.iterations * section.num_envs * section.steps
    auxiliary = frames / section.minibatch * section.epochs * 256
    samples = frames * (2 * section.epochs + 1 / 3) + auxiliary
    assert matched_steps(given) == round(samples / given.imitate.batch_size)
    once = options("self_examine.algorithm=reinforce", "self_examine.imitation_weight=0")
    assert matched_steps(once) == round(frames * (2 + 1 / 3) / once.imitate.batch_size)


def test_the_small_file_of_another_run_is_not_replaced(options, tmp_path, phase_1):
    from _shared import write_result

    kept = f"results={tmp_path / 'small files'}"
    write_result(options(kept), {"found": 1}, "demo")
    write_result(options(kept), {"found": 2}, "demo")
    with pytest.raises(UserError, match="tell them apart with variant="):
        write_result(options(kept, run="another"), {"found": 3}, "demo")
    write_result(options(kept, "variant=mine", run="another"), {"found": 3}, "demo")
    files = sorted((tmp_path / "small files").iterdir())
    assert sorted(read_json(file)["results"]["found"] for file in files) == [2, 3]


@pytest.mark.parametrize("share", [0.999, 0.001])
def test_some_demonstrations_are_held_out_and_some_are_not(recipes, share):
    from imitate import split_transitions

    from ifo_grounding.data import record_demonstrations

    demos = record_demonstrations("move", 30, seed=0)
    actions = torch.zeros(demos.transitions, dtype=torch.int64)
    with pytest.raises(UserError, match=f"held_out={share} of 30 demonstrations holds out"):
        split_transitions(demos, actions, share)
    with pytest.raises(UserError, match=r"actions for .* transitions"):
        split_transitions(demos, actions[1:], 0.5)
