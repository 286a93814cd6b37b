"""Both phases through the recipes: what they make, what is made once, what is refused."""

import re
import types

import pytest
import torch

from ifo_grounding import networks
from ifo_grounding.cli import main
from ifo_grounding.config import STAGES
from ifo_grounding.data import record_demonstrations
from ifo_grounding.envs import GymnasiumEnv
from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json, write_json
from ifo_grounding.mosaic import as_words, assemble
from ifo_grounding.report import results_rows, text_table
from ifo_grounding.training import Run
from pretended_gpu import pretended_gpu
from recipes.conftest import make_stages


def test_both_phases_of_strong_run_through_and_write_a_report(options, tmp_path):
    from share import share
    from two_phase import two_phase

    from report import report

    chosen = ["task=move-udlr", "world.split=train", "evaluate.split=zero-shot"]
    chosen.append(f"results={tmp_path / 'kept'}")
    first = two_phase(options("until=imitate", *chosen))
    run = tmp_path / "run"
    assert "phase2" not in first and "suitability" not in first
    stages = {path.stem for path in (run / "stages").glob("*.json")}
    assert "imitate" in stages and "train_instruction" not in stages

    given = options(*chosen)
    results = two_phase(given)
    assert results["phase1"] == first["phase1"]
    assert results["phase1"]["scenes"] == results["phase2"]["scenes"]
    assert results["phase1"]["rate"]["count"] == results["gain"]["count"] == 20
    assert "trained" in results and "continued" not in results
    assert 0 < results["labels"]["rate"]["rate"] <= 1
    table = text_table(results_rows(results))
    assert "phase 2 - phase 1" in table and "suitable rate" in table
    (file,) = (tmp_path / "kept").glob("*.json")
    assert file.name == "move-udlr-60-strong-seed0.json"
    kept = read_json(file)
    assert kept["results"] == results == read_json(run / "result.json")["results"]
    assert kept["options"]["preset"] == "strong" and kept["machines"]["imitate"]

    text = re.sub("base64,[A-Za-z0-9+/=]+", "", report(given).read_text())  # which may say anything
    assert "How self-examination went" in text and "http" not in text
    assert "unseen scenes" in text or "is kept" in text
    assert "scene by scene" in text and "How it was made" in text
    audit = read_json(run / "metrics" / "self_examine.json")
    assert [row["step"] for row in audit] == [1, 2]
    assert all("success" in row and "suitable" in row for row in audit)

    shared = tmp_path / "shared"
    folders = share(options(f"to={shared}"))
    assert {folder.name for folder in folders} >= {"policy", "inverse", "instruction"}
    policy = networks.from_pretrained(shared / "policy", kind="policy")
    trained = networks.load(run / "policy-phase2.safetensors")
    assert all(map(torch.equal, policy.state_dict().values(), trained.state_dict().values()))
    assert policy.vocabulary.decode(torch.tensor([[1]])) == ["circle"]
    assert trained.vocabulary == policy.vocabulary
    assert "| Task | move-udlr |" in (shared / "policy" / "README.md").read_text()

    # A second call finds everything done.
    stamps = {path: path.stat().st_mtime_ns for path in run.rglob("*.safetensors")}
    assert two_phase(given) == results
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())


def test_both_phases_of_paper_run_through_with_their_control(options, tmp_path):
    from two_phase import two_phase

    chosen = ["task=pick-udlr", "preset=paper", "self_examine.pairs=24", "controls.run=true"]
    results = two_phase(options(*chosen))
    assert results["continued"]["scenes"] == results["phase2"]["scenes"]
    assert results["action_reward"] and results["changes"]
    audit = read_json(tmp_path / "run" / "metrics" / "self_examine.json")
    assert "held_out_accuracy" in audit[-1]


def test_pairs_are_searched_once_for_one_classifier(options, monkeypatch, tmp_path):
    import self_examine

    given, run = options("self_examine.pairs=24"), Run(tmp_path / "run")
    make_stages(given, until="train_instruction")
    first = self_examine.chosen_starts(run, given)
    monkeypatch.setattr(self_examine, "select_pairs", lambda *_, **__: 1 / 0)
    again = self_examine.chosen_starts(run, given)
    assert len(first.scenes) == 24 and torch.equal(again.scenes, first.scenes)
    assert torch.equal(again.tokens, first.tokens)
    other = {**read_json(run / "networks.json"), "instruction.safetensors": None}
    write_json(run / "networks.json", other)
    with pytest.raises(ZeroDivisionError):
        self_examine.chosen_starts(run, given)


@pytest.mark.parametrize("preset", ["strong", pytest.param("paper", marks=pytest.mark.slow)])
def test_both_phases_run_on_a_gpu(options, preset):
    from two_phase import two_phase

    few = ["evaluate.episodes=10", "evaluate.mode=greedy", "self_examine.iterations=1"]
    few += ["evaluate.max_steps=4", "evaluate.states=4", "evaluate.audit_episodes=4"]
    few += ["imitate.steps=4", "inverse.steps=4", "self_examine.steps=4", "transitions.n=100"]
    with pretended_gpu():
        results = two_phase(options(f"preset={preset}", "device=cuda", *few))
    assert results["phase2"]["rate"]["count"] == 10
    assert results["phase1"]["scenes"] == results["phase2"]["scenes"]


def test_options_replace_values_and_other_options_or_networks_nothing(options, phase_1):
    from _shared import load_network, open_run
    from imitate import imitate

    weights = (phase_1 / "policy-phase1.safetensors").read_bytes()
    with pytest.raises(UserError, match=r"made with imitate\.steps=20, not 30.*another run="):
        imitate(options("imitate.steps=30"))
    assert (phase_1 / "policy-phase1.safetensors").read_bytes() == weights
    inverse = networks.load(phase_1 / "inverse.safetensors")
    assert inverse.network_config.config.features == 16
    with pytest.raises(UserError, match="sentence_rate"):
        make_stages(options("networks.sentence_rate=0.5", run="second"), until="train_inverse")
    other = networks.make_inverse(networks.Shapes((3, 8, 8), 9))
    networks.save(other, phase_1 / "inverse.safetensors")  # of another run
    with pytest.raises(UserError, match="not what was saved"):
        load_network(open_run(options()), "inverse.safetensors", options())


def test_a_new_run_takes_over_the_phase_1_of_another(options, tmp_path, capsys, phase_1):
    from _shared import open_run
    from two_phase import two_phase

    base = f"base={phase_1}"
    two_phase(options(base, "self_examine.lr=1e-3", "until=imitate", run="second"))
    assert "imitate: done before" in capsys.readouterr().out
    files = [tmp_path / run / "policy-phase1.safetensors" for run in ("run", "second")]
    assert files[0].read_bytes() == files[1].read_bytes()
    with pytest.raises(UserError, match=r"made with imitate\.steps=20, not 30"):
        two_phase(options(base, "imitate.steps=30", run="third"))
    with pytest.raises(UserError, match=r"made with preset=strong, not paper"):
        two_phase(options(base, "preset=paper", run="third"))
    assert not (tmp_path / "third" / "policy-phase1.safetensors").exists()
    with pytest.raises(UserError, match="no finished stages"):
        two_phase(options(f"base={tmp_path / 'none'}", run="fourth"))
    assert not (tmp_path / "none").exists()
    with pytest.raises(UserError, match=r"was made with base=null, not other"):
        open_run(options("base=other"))  # a run that has begun takes nothing more over
    open_run(options())
    open_run(options(base, "self_examine.lr=1e-3", run="second"))


def test_a_stage_without_what_it_needs_says_what_to_run(options, tmp_path, monkeypatch):
    from evaluate import evaluate
    from imitate import imitate
    from self_examine import examine

    monkeypatch.setattr("sys.argv", ["imitate.py", "run=a b", "until=label"])
    first = "record_demonstrations, collect_transitions, train_inverse, label"
    with pytest.raises(UserError, match=r"^there is no run .*run: .* demo 'run=a b' until=label"):
        imitate(options())
    assert not (tmp_path / "run").exists()
    (tmp_path / "run").mkdir()
    with pytest.raises(UserError, match=f"^evaluate needs {first}, imitate of .* until=imitate"):
        evaluate(options())
    with pytest.raises(UserError, match=r"train_instruction, train_goal of .* until=train_goal"):
        examine(options())
    (tmp_path / "move-few").mkdir()
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path / "home"))
    for run, hint in ("movefew", r" \(did you mean 'move-few'\?\)"), ("another", ""):
        with pytest.raises(UserError, match=f"^there is no run .*{run}{hint}: "):
            evaluate(options(run=run))


def test_other_scenes_are_measured_anew_and_kept(phase_1, capsys):
    given = ["evaluate", f"run={phase_1}", "evaluate.mode=greedy"]
    for episodes, said in (20, "running"), (10, "running"), (10, "done before"):
        main([*given, f"evaluate.episodes={episodes}"])
        assert f"evaluate: {said}\n" in capsys.readouterr().out
        kept = read_json(phase_1 / "result.json")
        assert kept["results"]["phase1"]["rate"]["count"] == episodes
        assert kept["command"].endswith(f"evaluate.mode=greedy evaluate.episodes={episodes}")


def test_what_could_not_be_kept_or_compared_is_refused_first(options, tmp_path):
    from two_phase import two_phase

    record_demonstrations("move", 4).save(tmp_path / "shown")
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(UserError, match=r"results=.*/file is a file; name a folder"):
            options(f"results={folder}")
    with pytest.raises(UserError, match="references=true imitates true actions"):
        two_phase(options(f"recorded={tmp_path / 'shown'}", "references=true"))
    assert not (tmp_path / "run").exists()


def test_a_run_until_its_labels_is_not_evaluated(options):
    from imitate import imitate
    from two_phase import two_phase

    assert two_phase(options("until=label")) == {}
    assert imitate(options())["step"] == 20  # which needs no other stage


@pytest.mark.parametrize(
    ("pool", "closed", "world", "said"),
    [
        (1, True, (), "have one instruction"),
        (2, False, (), "are cut short"),
        (2, True, ("world=gymnasium", "world.id=ifo_grounding/Move-v0"), "has no stop"),
        (2, False, ("preset=paper",), None),
    ],
)
def test_a_run_without_a_phase_2_ends_with_phase_1(
    options, monkeypatch, capsys, pool, closed, world, said
):
    import two_phase

    done, demos = [], types.SimpleNamespace(pool=lambda: [0] * pool, closed=torch.tensor([closed]))
    stages = {name: lambda _, name=name: done.append(name) for name in STAGES}
    monkeypatch.setattr(two_phase, "stages_of", lambda _: stages)
    for name in ("open_run", "evaluate", "write_result"):
        monkeypatch.setattr(two_phase, name, lambda *_: {})
    monkeypatch.setattr(two_phase, "load_demonstrations", lambda _: demos)
    monkeypatch.setattr(two_phase, "simulator_of", lambda _: object.__new__(GymnasiumEnv))
    two_phase.two_phase(options(*world))
    assert (said or "") in capsys.readouterr().out
    assert done[-1] == ("imitate" if said else "self_examine")


def test_the_instruction_classifier_tries_the_policys_roles_and_sees_fresh_states(options):
    from _shared import load_demonstrations, load_network, open_run
    from train_instruction import fresh_states, losses

    given = options("task=pick", "instruction.fresh_states=301", "instruction.trials=3")
    make_stages(given, until="imitate")
    run = open_run(given)
    policy = load_network(run, "policy-phase1.safetensors", given)
    tried = losses(given, run, load_demonstrations(run), None)
    theirs, *own = (
        next(part for part in each.modules() if isinstance(part, networks.grounding.WordMaps))
        for each in (policy, *tried)
    )
    for part, last in (("about_form.weight", True), ("role.weight", False)):
        weight = theirs.state_dict()[part]
        alike = [torch.equal(words.state_dict()[part], weight) for words in own]
        assert alike == [True, True, last]
    heads = [each.network.module.head[1].weight for each in tried]
    assert not torch.equal(heads[0], heads[1])
    assert fresh_states(given, 301) is None
    states = fresh_states(given, 300)
    assert len(states) == len(states.flatten(1).unique(dim=0)) == 301


def test_the_own_world_is_learned_from_in_codes_of_one_simulator(options):
    from _shared import coded_simulator, load_network, open_run, read_fast
    from imitate import labelled_demonstrations

    given = options("task=pick")
    make_stages(given, until="imitate")
    run, simulator = open_run(given), coded_simulator(given, 3)
    policy = load_network(run, "policy-phase1.safetensors", given)
    seen, _ = labelled_demonstrations(run, 0.0)
    pixels = seen[:]["pixels"]
    expected = policy(seen[:])["logits"]
    read_fast(seen, given)
    codes = seen[:]["pixels"]
    assert codes.dtype == simulator.reset()["pixels"].dtype == torch.int16
    assert torch.equal(assemble(as_words(simulator.tiles), codes), pixels)
    torch.testing.assert_close(policy(seen[:])["logits"], expected)


def test_what_is_measured_otherwise_is_measured_anew(options, capsys, phase_1):
    from evaluate import evaluate

    found = evaluate(options("evaluate.episodes=20", "evaluate.mode=sampled"))["phase1"]
    assert (found["rate"]["count"], found["mode"]) == (20, "sampled")
    assert not capsys.readouterr().err
    chosen = ["evaluate.episodes=10", "evaluate.mode=greedy", "evaluate.split=zero-shot"]
    again = evaluate(options(*chosen))["phase1"]
    assert again["rate"]["count"] == 10 and not again["sampled"]
    # The demonstrations named the pairs of these scenes, too.
    assert "no zero-shot success" in capsys.readouterr().err


def test_the_small_file_of_another_run_is_not_replaced(options, tmp_path):
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
