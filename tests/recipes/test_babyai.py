import json

import pytest
import torch

pytest.importorskip("minigrid")

from ifo_grounding import networks
from ifo_grounding.data import Demonstrations
from ifo_grounding.errors import UserError
from ifo_grounding.report import results_table

TINY = [
    *("demonstrations.n=60", "transitions.n=1000", "processes=1"),
    *("imitate.lr=1e-4", "self_examine.steps=20"),
]
ONE_ROOM = [
    *("GoToLocalS5N2", "PickupLoc", "PickupDist", "PutNextLocalS5N3"),
    *("FindObjS5", "OpenDoor", "GoToObjDoor"),
]
ONE_MISSION = ["GoToRedBallGrey", "OneRoomS12"]


def test_both_phases_run_in_babyai(compose, tmp_path):
    from study import study

    from report import report

    options = compose(
        "study",
        *("world=babyai", "level=GoToObj", "references=true", *TINY),
        f"results={tmp_path / 'results'}",
    )
    results = study(options)
    names = ("phase1", "phase2", "continued", "cloned", "true_actions")
    assert len({results[name]["scenes"] for name in names}) == 1
    assert all(results[name]["rate"]["count"] == 50 for name in (*names, "demonstrator"))
    assert results["demonstrator"]["rate"]["rate"] == 1.0
    assert set(results["labels"]["per_action"]) >= {"left", "forward", "done"}
    assert "goal_return" in results and "suitability" not in results and "endings" not in results
    assert "demonstrator, success (reference)" in results_table(results)
    audit = json.loads((tmp_path / "run" / "metrics" / "self_examine.json").read_text())
    assert "success" in audit[-1] and "suitable" not in audit[-1]

    # The words are those of the demonstrations, and go with the policy.
    demos = Demonstrations.load(tmp_path / "run" / "demonstrations")
    policy = networks.load(tmp_path / "run" / "policy-phase2.safetensors")
    assert demos.vocabulary.decode(demos.pool()[:1])[0].startswith("go to")
    assert policy.network_config.shapes.vocabulary_size == len(demos.vocabulary)
    judge = networks.load(tmp_path / "run" / "goal.safetensors")
    assert judge.network_config.config.context == 1  # sees what the agent faces

    [path] = (tmp_path / "results").glob("*.json")
    assert path.name == "GoToObj-60-strong-seed0.json"
    assert "Self-examination" in report(options).read_text()


def test_true_actions_reach_the_reference_alone(compose, tmp_path):
    from collect_transitions import collect
    from imitate import imitate
    from label import label
    from record_demonstrations import record
    from references import imitate_truth
    from train_inverse import train_inverse

    options = compose("references", "world=babyai", "level=GoToObj", *TINY)
    for stage in (record, collect, train_inverse, label, imitate, imitate_truth):
        stage(options)
    run = tmp_path / "run"
    files = ("policy-phase1.safetensors", "reference-true-actions.safetensors")
    labelled, reference = (networks.load(run / file).state_dict() for file in files)
    truth = run / "truth"
    assert any(not torch.equal(labelled[name], reference[name]) for name in labelled)
    # Phase 1 does without the truth.
    truth.rename(run / "elsewhere")
    (run / "stages" / "imitate.json").unlink()
    imitate(options)
    again = networks.load(run / files[0]).state_dict()
    assert all(torch.equal(labelled[name], again[name]) for name in labelled)


def test_what_babyai_has_not_is_refused(compose):
    from _worlds import open_world

    world = open_world(compose("two_phase", "world=babyai"))
    with pytest.raises(UserError, match="split"):
        world.played(5, seed=0, stream="evaluation", split="zero-shot")
    with pytest.raises(UserError, match="GoToMoon"):
        open_world(compose("two_phase", "world=babyai", "level=GoToMoon")).demonstrate(1)


@pytest.mark.slow
@pytest.mark.parametrize("level", ONE_ROOM)
def test_levels_of_one_room_start(compose, level):
    from two_phase import two_phase

    small = ["evaluate.episodes=8", "evaluate.audit_episodes=8", "self_examine.iterations=1"]
    results = two_phase(compose("two_phase", "world=babyai", f"level={level}", *TINY, *small))
    assert results["phase2"]["rate"]["count"] == 8


@pytest.mark.slow
@pytest.mark.parametrize("level", ONE_MISSION)
def test_levels_of_one_mission_leave_nothing_to_choose(compose, level):
    from two_phase import two_phase

    options = compose("two_phase", "world=babyai", f"level={level}", *TINY, "evaluate.episodes=8")
    with pytest.raises(UserError, match="different instructions"):
        two_phase(options)
    options.phase2 = False
    assert two_phase(options)["phase1"]["rate"]["count"] == 8
