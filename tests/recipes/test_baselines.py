"""The recipe of the rivals: each method trains a little, is measured, and is done then."""

import shutil

import pytest

from ifo_grounding import networks
from ifo_grounding.baselines import AGILE
from ifo_grounding.baselines.config import METHODS
from ifo_grounding.cli import main
from ifo_grounding.config import STAGES
from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json
from ifo_grounding.options import options_of
from ifo_grounding.training import Run
from importing import recipes_importable
from pretended_gpu import pretended_gpu
from recipes.conftest import TINY, make_stages

FEWER = (
    "baseline.frames=160",
    "baseline.steps=1",
    "demonstrations.n=20",
    "baseline.likelihood_steps=2",
)
OTHERWISE = {"bco-alpha": "baseline.alpha=3", "lc-rl": "baseline.likelihood_steps=7"}


@pytest.fixture(scope="module")
def practised(tmp_path_factory):
    """The folder of a run that has both phases."""
    folder = tmp_path_factory.mktemp("practised") / "run"
    with recipes_importable():
        make_stages(options_of(*TINY, *FEWER, f"run={folder}"), until=STAGES[-1])
    return folder


@pytest.mark.parametrize("method", METHODS)
def test_a_method_is_trained_and_measured(method, practised, options, tmp_path):
    from baselines import baseline
    from report import rivals

    run = shutil.copytree(practised, tmp_path / "run")
    given = options(*FEWER, f"method={method}")
    results = baseline(given)
    (row,) = rivals(Run(run), {})
    assert row["measured"] == f"{method} (baseline), success"
    assert row["result [95% interval]"].as_dict() == results[method]["rate"]
    beside = rivals(Run(run), {"true_actions": results, "demonstrator": results})
    assert beside == ([] if method in ("bc", "expert") else [row])  # which stand there already
    assert 0 <= results[method]["rate"]["rate"] <= 1 and results[method]["rate"]["count"] == 20
    if method == "ours":
        assert [frames for frames, _ in results["curve"]] == [80, 160]
    trained = run / "stages" / f"baseline_{method}.json"
    if trained.exists():
        found = read_json(trained)["result"]
        if method == "bco-alpha":
            assert 0 <= found["labels_changed"] <= 1
        elif method == "lc-rl":
            assert found["loss_likelihood"] > 0
        else:
            rows = read_json(run / f"metrics/baseline_{method}.json")
            frames = sum(row["frames"] for row in rows)
            assert frames >= 160 and results["curve"][-1][0] == frames
            said = results["discriminator"]
            assert said.keys() == {"demonstrated", "policy", "unseen"}
            assert all(0 < probability < 1 for probability in said.values())
        with pytest.raises(UserError, match=r"made with baseline\..* or give base="):
            baseline(options(*FEWER, f"method={method}", OTHERWISE.get(method, "baseline.steps=3")))
        unread = "baseline.steps=3" if method in OTHERWISE else "baseline.alpha=3"
        assert baseline(options(*FEWER, f"method={method}", unread)) == results
    stamp = trained.stat().st_mtime_ns if trained.exists() else None
    assert baseline(given) == results
    assert stamp is None or trained.stat().st_mtime_ns == stamp
    policy = run / f"policy-{method}.safetensors"
    if policy.exists():
        policy.unlink()
        with pytest.raises(UserError, match="run the recipe baselines"):
            baseline(given)
        assert not trained.exists()  # to run it again helps


def test_an_interrupted_rival_goes_on_as_it_began_alone(practised, options, tmp_path, monkeypatch):
    import baselines

    class Killed(Exception):
        pass

    def kill(*_):
        raise Killed

    shutil.copytree(practised, tmp_path / "run")
    given = options(*FEWER, "method=gail", "checkpoint_seconds=0")
    monkeypatch.setattr(baselines, "save_network", kill)
    with pytest.raises(Killed):
        baselines.baseline(given)
    monkeypatch.undo()
    for name, value in ("lr", "0.01"), ("steps", "2"):
        with pytest.raises(UserError, match=f"{name}=.*, not {value}: leave it out, or give base="):
            baselines.baseline(options(*FEWER, "method=gail", f"baseline.{name}={value}"))
    assert baselines.baseline(given)["gail"]["rate"]["count"] == 20


def test_a_rival_trained_anew_is_measured_anew(practised, options, tmp_path):
    from _shared import checksums

    from baselines import baseline

    run = Run(shutil.copytree(practised, tmp_path / "run"))
    measured = []
    for lr in (1e-3, 3e-2):
        given = options(*FEWER, "method=gail", f"baseline.lr={lr}")
        if measured:  # what a user does who has lost the policy
            (run / "policy-gail.safetensors").unlink()
            with pytest.raises(UserError, match="run the recipe baselines"):
                baseline(options(*FEWER, "method=gail", "baseline.lr=0.001"))
        baseline(given)
        measured.append(run.record("evaluate_gail")["result"]["of"]["policy"])
    assert measured[0] != measured[1] == checksums(run)["policy-gail.safetensors"]


def test_a_rival_has_the_policy_of_the_run(options, tmp_path):
    from baselines import baseline

    given = options(*FEWER, "imitate.context=1", "method=gail+bc", run="wide")
    assert 0 <= baseline(given)["gail+bc"]["rate"]["rate"] <= 1
    policy = networks.load(tmp_path / "wide" / "policy-gail+bc.safetensors")
    assert policy.network_config.config.context == 1


def test_where_phase_2_has_no_discount_a_rival_learns_by_the_defaults(options, tmp_path):
    from baselines import baseline

    given = options(*FEWER, "preset=paper", "method=agile", run="paper")
    assert given.self_examine.gamma == 0
    practice = AGILE.practice(given.self_examine)
    assert (practice.algorithm, practice.gamma, practice.steps) == ("ppo", 0.99, 10)
    assert 0 <= baseline(given)["agile"]["rate"]["rate"] <= 1


def test_a_rival_that_needs_what_a_world_lacks_says_so(practised, options, tmp_path):
    from baselines import baseline

    run = shutil.copytree(practised, tmp_path / "run")
    shutil.rmtree(run / "truth")
    with pytest.raises(UserError, match="hold no true actions"):
        baseline(options(*FEWER, "method=gail"))
    with pytest.raises(UserError, match="task=move or"):
        baseline(options(*FEWER, "method=lc-rl", "task=pick", run="another"))
    with pytest.raises(UserError, match="method"):
        options("method=dagger")


@pytest.mark.parametrize("method", ["lc-rl", "gaifo"])
def test_a_rival_runs_on_a_gpu(method, options):
    from baselines import baseline

    few = ["imitate.steps=4", "inverse.steps=4", "instruction.steps=4", "evaluate.max_steps=4"]
    few += ["transitions.n=100", "evaluate.audit_episodes=4"]
    with pretended_gpu():
        found = baseline(options(*FEWER, *few, f"method={method}", "device=cuda", run="gpu"))
    assert found[method]["rate"]["count"] == 20


def test_the_result_of_a_rival_is_not_that_of_the_run(practised, tmp_path, recipes):
    run = shutil.copytree(practised, tmp_path / "run")
    main(["run", "baselines", f"run={run}", "method=random", f"results={tmp_path / 'results'}"])
    kept = read_json(run / "result-random.json")["results"]
    assert kept["random"]["rate"]["count"] == 20
    assert not (run / "result.json").exists()  # of which a model card tells
