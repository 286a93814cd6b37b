"""A real Ray cluster of two nodes on this machine, of which workers and a node are killed."""

import contextlib
import os
import signal
import threading
import time
from pathlib import Path

import pytest
import torch
from torchrl.envs import TransformedEnv

from comparing import assert_same
from ifo_grounding.cli import main
from ifo_grounding.cluster import Call, run_on_cluster
from ifo_grounding.data import record_babyai
from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json
from ifo_grounding.keys import ACTION, LEARNED_REWARD, NEXT, PIXELS
from ifo_grounding.networks import Shapes, make_reward_model
from ifo_grounding.options import options_of_jobs
from ifo_grounding.seeding import derive
from ifo_grounding.training import collection
from ifo_grounding.training.collection import Here, OnRay
from recipes.conftest import TINY as TINY_RECIPES
from recipes.test_reproduce import TINY
from training.tiny import make_env, make_networks, prefer, simulator

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
ray = pytest.importorskip("ray", reason="the extra ray")
MEMORY = 100 * 2**20


@pytest.fixture
def cluster(monkeypatch, tmp_path):
    """Two nodes of one processor each; the second one may be removed."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path))
    node = {"num_cpus": 1, "object_store_memory": MEMORY}
    cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    cluster.second = cluster.add_node(**node)
    monkeypatch.setenv("RAY_ADDRESS", cluster.address)
    try:
        yield cluster
    finally:
        ray.shutdown()
        cluster.shutdown()


def processes(name):
    """Return the processes of Ray that run a function or an actor of a name, by their numbers."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if path.read_text().startswith(f"ray::{name}"):
                found.append(int(path.parent.name))
    return found


def soon(condition, seconds=240):
    """Wait until a condition holds, and return what it says."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if found := condition():
            return found
        time.sleep(0.1)
    raise TimeoutError(condition)


def measured(folder):
    return {
        path.name: read_json(path)["results"] for path in sorted((folder / "tables").glob("*.json"))
    }


@pytest.mark.timeout(1800)
def test_a_table_is_the_same_after_a_worker_and_a_node_have_died(cluster, recipes, tmp_path):
    from reproduce import reproduce

    def asked(results, *more):
        given = [f"results={tmp_path / results}", "seeds=[0,1]", "table=3", *TINY, *more]
        return options_of_jobs(recipes / "reproduce.py", given)[0]

    killed = []

    def kill():
        soon(lambda: len([*tmp_path.glob("runs/*/stages/label.json")]) == 2)
        killed.append(processes("_run")[0])
        os.kill(killed[0], signal.SIGKILL)
        soon(lambda: len({*processes("_run")} - {*killed}) == 2)
        cluster.remove_node(cluster.second, allow_graceful=False)
        killed.append("node")

    killer = threading.Thread(target=kill)
    killer.start()
    assert reproduce(asked("on-ray", "ray=true")) == []
    killer.join()
    assert len(killed) == 2
    (tmp_path / "runs").rename(tmp_path / "runs-on-ray")
    assert reproduce(asked("here", "jobs=2")) == []
    found = measured(tmp_path / "on-ray")
    assert len(found) == 2 and found == measured(tmp_path / "here")


@pytest.mark.timeout(1800)
def test_practice_ends_with_one_line_where_a_node_is_missing_and_goes_on_when_it_is_back(
    cluster, monkeypatch
):
    monkeypatch.setattr(collection, "PATIENCE", 15)
    policy, _ = make_networks()
    made = make_env(num_envs=8).transform

    def make():
        return TransformedEnv(simulator(4), made.clone())

    where = OnRay(make_env(num_envs=8), policy, 5, [make] * 2)
    before, _ = where.collect(seed=1)
    cluster.remove_node(cluster.second, allow_graceful=False)
    with pytest.raises(UserError, match="2 collectors need a free processor each, of 1 in the Ray"):
        where.collect(seed=1)
    cluster.add_node(num_cpus=1, object_store_memory=MEMORY)
    after, _ = where.collect(seed=1)
    where.close()
    assert torch.equal(before[PIXELS], after[PIXELS])
    assert torch.equal(before[ACTION], after[ACTION])


def test_babyais_bot_is_recorded_by_all_processors(cluster):
    pytest.importorskip("minigrid")
    one, all_of_them = (record_babyai("GoToLocal", 8, seed=1, processes=n) for n in (1, 2))
    assert_same(one, all_of_them)
    assert ray.is_initialized()


@pytest.fixture
def one_machine(monkeypatch):
    """Ray on this machine alone, with two processors."""
    ray.init(num_cpus=2, include_dashboard=False, object_store_memory=MEMORY, log_to_driver=False)
    yield
    ray.shutdown()


def test_workers_act_by_the_newest_weights_also_of_the_networks_in_transforms(one_machine):
    model = make_reward_model(Shapes((3, 48, 48), 64, tile_size=8), features=16, seed=0)
    policy, _ = make_networks()
    made = make_env(model, num_envs=8).transform

    def make():
        return TransformedEnv(simulator(4), made.clone())

    env = make_env(model, num_envs=8)
    where = OnRay(env, policy, 5, [make] * 2)
    try:
        first, counted = where.collect(seed=1)
        again, _ = where.collect(seed=1)
        assert first.shape == (8, 5) and counted["states_served"] >= 8
        assert (first[ACTION] == again[ACTION]).all()
        assert not torch.equal(first[PIXELS][:4], first[PIXELS][4:])  # workers have their own seeds
        alone, _ = Here(make(), policy, 5).collect(derive(1, "worker", 0))
        for key in (PIXELS, (NEXT, PIXELS), ACTION, (NEXT, "done"), (NEXT, LEARNED_REWARD)):
            assert torch.equal(first[key][:4], alone[key]), key
        prefer(policy, 3, by=50.0)
        with torch.no_grad():
            for weight in model.parameters():
                weight.zero_()
        later, _ = where.collect(seed=1)
        assert (first[ACTION] != 3).any() and (later[ACTION] == 3).all()
        paid = [batch[NEXT, LEARNED_REWARD] for batch in (first, later)]
        assert (paid[0] != 0.5).any() and (paid[1] == 0.5).all()
        (victim, *_) = processes("Worker")
        os.kill(victim, signal.SIGKILL)
        after, _ = where.collect(seed=1)
        assert torch.equal(later[PIXELS], after[PIXELS])
    finally:
        where.close()


@pytest.mark.timeout(1800)
def test_a_recipe_collects_the_same_where_a_worker_has_died(one_machine, options, phase_1):
    from self_examine import examine
    from train_goal import train_goal
    from train_instruction import train_instruction

    def examined(run):
        given = ("self_examine.collectors=2", "self_examine.iterations=2", f"base={phase_1}")
        chosen = options(*given, run=run)
        train_instruction(chosen)
        train_goal(chosen)
        assert examine(chosen)["frames"] == 8 * 10
        return read_json(phase_1.parent / run / "metrics/self_examine.json")

    def kill():
        killed.append(soon(lambda: processes("Worker")[1:])[0])
        os.kill(killed[0], signal.SIGKILL)

    killed = []
    undisturbed = examined("undisturbed")
    assert len(undisturbed) == 2 and undisturbed[-1]["states_served"] >= 8
    assert "selection_return" in undisturbed[-1]
    soon(lambda: not processes("Worker"))
    killer = threading.Thread(target=kill)
    killer.start()
    assert examined("disturbed") == undisturbed
    killer.join()
    assert killed


@pytest.mark.timeout(1800)
def test_jobs_of_multirun_run_on_ray_and_what_fails_is_named(one_machine, tmp_path, monkeypatch):
    monkeypatch.setenv("IFO_GROUNDING_HOME", str(tmp_path))
    given = ["record", "--multirun", "ray=true", *TINY_RECIPES, "run='${task}-${seed}'"]
    main([*given, "seed=0,1"])
    assert {path.parent.name for path in tmp_path.glob("runs/*/demonstrations")} == {
        "move-0",
        "move-1",
    }
    calls = [
        Call("imitate", ("run=move-0",), "move-0", tmp_path / "a.log"),
        Call("collect_transitions", ("run=move-0",), "move-0", tmp_path / "b.log"),
    ]
    assert run_on_cluster([calls], progress=False) == calls[:1]
    assert "imitate needs collect_transitions" in calls[0].log.read_text()
    assert not calls[1].log.exists()
