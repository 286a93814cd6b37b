"""Ray and torchrun beside one process: ``python benchmarks/scale.py [row ...]``, on two idle cores.

Contenders take turns. Writes ``results/bench/scale.json``, of which ``python docs/make_results.py``
makes the tables of docs/scale.md: what was measured, and a model of many workers from it.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from measuring import ROOT, Row, timed
from torch import nn
from torchrl.envs import Compose, TransformedEnv

from ifo_grounding import keys, networks
from ifo_grounding.cluster import Call, run_on_cluster
from ifo_grounding.data import labelled_buffer, record_demonstrations
from ifo_grounding.files import read_json, write_json
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.report import provenance
from ifo_grounding.training import FitConfig, SelfExaminationConfig, fit
from ifo_grounding.training.collection import FIRST, LEFT_OUT, Here, OnRay, ends
from ifo_grounding.training.policy_gradient import Learner
from ifo_grounding.transforms import GoalReward, InstructionSampler
from ifo_grounding.worlds import BabyAI

OUT = ROOT / "results" / "bench" / "scale.json"
WORLDS, STEPS, BATCH = 64, 20, 4096
PIECE = ("budget=tiny", "until=imitate", "evaluate.episodes=100", "evaluate.states=0")
PIECE += ("progress=false", "logger=none")
NETWORK = 1e9 / 8
"""Bytes per second of the model's network: 1 Gbit/s."""
WORKERS = (1, 2, 4, 8, 16, 32, 64)


def pieces() -> Row:
    """Pieces of a table, two side by side, from nothing; that Ray starts is not counted."""
    home = Path(tempfile.mkdtemp())
    os.environ["IFO_GROUNDING_HOME"] = str(home)
    made = iter(range(10_000))

    def calls() -> list[Call]:
        runs = [f"piece-{next(made)}" for _ in range(4)]
        given = [(*PIECE, f"run={run}", f"seed={seed}") for seed, run in enumerate(runs)]
        logs = [home / f"{run}.log" for run in runs]
        return [Call("two_phase", *rest) for rest in zip(given, runs, logs, strict=True)]

    def on_ray() -> float:
        chains = [[call] for call in calls()]
        assert not run_on_cluster(chains, progress=False)
        return 3600 * len(chains)

    def here(call: Call) -> None:
        command = [sys.executable, "-m", "ifo_grounding", "run", call.recipe, *call.options]
        threads = {**os.environ, "OMP_NUM_THREADS": "1"}
        subprocess.run(command, env=threads, check=True, stdout=subprocess.DEVNULL)

    def jobs() -> float:
        with ThreadPoolExecutor(2) as pool:
            return 3600 * len([*pool.map(here, calls())])

    contenders = {"2 Ray workers": timed(on_ray), "jobs=2": timed(jobs)}
    return Row("pieces of a table", "pieces/hour", contenders)


def babyai() -> tuple[BabyAI, Compose, nn.Module, Learner]:
    """Return a world, what chooses instructions and pays in it, a policy and what improves it."""
    world = BabyAI("GoToLocal")
    demos, _ = world.demonstrate(64, seed=0)
    world.vocabulary = demos.vocabulary
    shown = world.coded(1, seed=0)
    policy, value = (make(shown, seed=0) for make in (networks.make_policy, networks.make_value))
    sampler = InstructionSampler(
        networks.make_instruction_classifier(shown, seed=0), demos.pool(), threshold=0.0
    )
    goal = GoalReward(networks.make_goal_classifier(shown, seed=0), stop_action=world.stop_action)
    learner = Learner(policy, value, SelfExaminationConfig(steps=STEPS))
    learner.prepare(cudagraph=False)
    return world, Compose(sampler, goal), policy, learner


def practice() -> Row:
    """Iterations of self-examination in BabyAI: to collect, and to learn from it."""
    world, rewarded, policy, learner = babyai()

    def make(rows: int = WORLDS // 2) -> TransformedEnv:
        return TransformedEnv(world.coded(rows, seed=0), rewarded.clone())

    here = Here(make(WORLDS), policy, STEPS)
    on_ray = OnRay(make(WORLDS), policy, STEPS, [make] * 2)

    def iteration(where: Here | OnRay) -> float:
        batch, _ = where.collect(0)
        learner.improve(batch, 5)
        return batch.numel()

    contenders = {
        "2 Ray collectors": timed(lambda: iteration(on_ray)),
        "one process": timed(lambda: iteration(here)),
    }
    return Row("practice in BabyAI", "frames/s", contenders)


def model() -> Row:
    """What practice in BabyAI costs a processor and sends, for the model of many workers."""
    torch.set_num_threads(1)
    world, rewarded, policy, learner = babyai()
    env = TransformedEnv(world.coded(WORLDS, seed=0), rewarded)
    here, frames = Here(env, policy, STEPS), WORLDS * STEPS
    seconds: dict[str, list[float]] = {"collect": [], "learn": []}
    for number in range(6):
        begun = time.process_time()  # others that compute here do not count
        batch, _ = here.collect(number)
        collected = time.process_time()
        learner.improve(batch, 5)
        seconds["collect"].append(collected - begun)
        seconds["learn"].append(time.process_time() - collected)
    micro = {name: 1e6 * statistics.median(each[1:]) / frames for name, each in seconds.items()}
    sent, pixels = batch.exclude(*LEFT_OUT, *FIRST, keys.NEXT_PIXELS), batch[keys.NEXT_PIXELS]
    left = pixels[ends(batch)].nbytes
    weights = [*policy.parameters(), *env.transform.parameters()]
    facts = {
        "microseconds to collect a frame": micro["collect"],
        "microseconds to learn from a frame": micro["learn"],
        "bytes of a frame": (sent.bytes() + left) / frames,
        "bytes of the weights": sum(weight.nbytes for weight in weights),
    }
    return Row("one process", "", {}, facts=facts)


def imitation() -> Row:
    """Imitation by two processes that share each batch, by one, and by two that learn apart.

    The latter have a batch of half the size each, so that only waiting for each other is left out.
    """

    def learn(count: int, size: int = BATCH) -> tuple[float, float]:
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
        command += [f"--nproc-per-node={count}", __file__, "--imitate", str(size)]
        threads = {**os.environ, "OMP_NUM_THREADS": "1"}
        ended = subprocess.run(command, env=threads, check=True, text=True, stdout=-1)
        samples, taken = json.loads(ended.stdout.splitlines()[-1])
        return samples, taken

    def learn_apart() -> tuple[float, float]:
        with ThreadPoolExecutor(2) as pool:
            samples, taken = zip(*pool.map(learn, (1, 1), (BATCH // 2,) * 2), strict=True)
        return sum(samples), max(taken)

    contenders = {
        "2 processes": lambda: learn(2),
        "1 process": lambda: learn(1),
        "2 processes that learn apart": learn_apart,
    }
    return Row("imitation, preset strong", "samples/s", contenders)


def imitate(size: int) -> None:
    """Imitate in this process, one of those of torchrun; the first tells samples and seconds."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.distributed.init_process_group("gloo")
    demos, truth = record_demonstrations("move", 2000, seed=0, keep_truth=True)
    loss = ImitationLoss(networks.make_policy(demos, "strong", seed=0))
    config = FitConfig(steps=60, batch_size=size, iteration=20)
    history = fit(loss, labelled_buffer(demos, truth.actions), config, seed=0)[1:]
    samples = config.iteration * config.batch_size
    taken = sum(samples / row["samples_per_second"] for row in history)
    if not torch.distributed.get_rank():
        print(json.dumps([samples * len(history), taken]))
    torch.distributed.destroy_process_group()


def growth(facts: dict[str, float]) -> dict[str, Any]:
    """Model practice with many workers of ``WORLDS`` worlds each, which collect side by side.

    All else comes one after the other: the weights to every worker, and all frames to the learner,
    over a network of ``NETWORK`` bytes a second, and the updates. ``bound`` leaves the updates out,
    as for a learner on a fast GPU. ``limit`` is how many workers keep the learner as busy as they
    are themselves.
    """
    frames = WORLDS * STEPS
    collect = 1e-6 * facts["microseconds to collect a frame"]
    learn = 1e-6 * facts["microseconds to learn from a frame"]
    receive = (facts["bytes of a frame"] + facts["bytes of the weights"] / frames) / NETWORK
    rows = [
        {
            "workers": workers,
            "frames/s": workers / (collect + workers * (learn + receive)),
            "bound": workers / (collect + workers * receive),
        }
        for workers in WORKERS
    ]
    limit = {"frames/s": collect / (learn + receive), "bound": collect / receive}
    return {"rows": rows, "limit": limit}


ROWS = {"pieces": pieces, "practice": practice, "imitation": imitation, "model": model}


def main() -> None:
    for name in sys.argv[1:] or list(ROWS):
        found = ROWS[name]().measure(repeats=3)
        print(name, found["rates"], found["ratios"], flush=True)
        load = [round(each, 1) for each in os.getloadavg()]
        content = read_json(OUT) if OUT.exists() else {"rows": {}}
        content["rows"][name] = {**found, "provenance": {**provenance(), "load": load}}
        if name == "model":
            content["growth"] = growth(found["facts"])
        write_json(OUT, content)


if __name__ == "__main__":
    imitate(int(sys.argv[2])) if "--imitate" in sys.argv else main()
