"""What is measured: each function builds one row of the table."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import numpy as np
import torch
from measuring import ROOT, Once, Peer, Row, peak_memory, resident_memory, timed
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from ifo_grounding import keys, networks
from ifo_grounding.data import (
    Demonstrations,
    collect_transitions,
    label_demonstrations,
    labelled_buffer,
    record_demonstrations,
    show_codes,
)
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.envs.simulator import AHEAD, Simulator
from ifo_grounding.files import read_json
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.seeding import Lots
from ifo_grounding.tasks import SceneOptions, grammar
from ifo_grounding.training import FitConfig, fit
from ifo_grounding.transforms import InstructionSampler
from ifo_grounding.world import (
    Canvas,
    WorldState,
    random_layout,
    render,
    step,
    tile_index,
    tile_table,
)

DEVICE = "cpu"
PRESETS = ("strong", "paper")


def on_gpu() -> bool:
    return DEVICE.startswith("cuda")


def finish() -> None:
    """Wait for the device, so that time is that of work done and not of work asked for."""
    if on_gpu():
        torch.cuda.synchronize()


def finished(work: Callable[[], float]) -> Once:
    """Time a function, with what it has asked of the device."""

    def wait() -> float:
        done = work()
        finish()
        return done

    return timed(wait)


def ours(work: Callable[[], float]) -> dict[str, Once]:
    return {"ifo-grounding": finished(work)}


def world_step() -> Row:
    batch, steps = 4096, 200
    first = random_layout(Lots(0, torch.arange(batch, device=DEVICE)))
    actions = torch.randint(6, (steps, batch), device=DEVICE)

    def walk(state: WorldState, some: torch.Tensor) -> WorldState:
        for action in some:
            state = step(state, action)
        return state

    def play(advance: Callable, at_once: int) -> float:
        state = first
        for some in actions.split(at_once) if at_once > 1 else actions:
            state = advance(state, some)
        return batch * steps

    compiled = torch.compile(walk, dynamic=False)
    assert (compiled(first, actions[:5]) == walk(first, actions[:5])).all()
    peer = Peer("navix")
    return Row(
        "world step, batch 4,096",
        "steps/s",
        {
            **ours(lambda: play(compiled, 5)),
            "not compiled": finished(lambda: play(step, 1)),
            **peer.contender("step"),
        },
        "ours by torch.compile, five steps at a time, as navix is by JAX, all at once; navix: an "
        "empty room of 6x6 cells, which holds no objects",
        peers=[peer],
    )


def world_pixels() -> Row:
    batch, steps = 1024, 40
    first = random_layout(Lots(0, torch.arange(batch, device=DEVICE)))
    actions = torch.randint(6, (steps, batch), device=DEVICE)
    table = tile_table().to(DEVICE)

    def play(draw: Callable) -> float:
        state = first
        for action in actions:
            state = step(state, action)
            draw(state)
        return batch * steps

    def naive(state) -> torch.Tensor:
        tiles = table[tile_index(state).long()]  # [N, rows, columns, C, T, T]
        return tiles.permute(0, 3, 1, 4, 2, 5).reshape(batch, 3, 48, 48)

    frames = render(first)
    assert torch.equal(frames, naive(first))
    peers = Peer("navix"), Peer("minigrid")
    return Row(
        "step and pixels, batch 1,024",
        "frames/s",
        {
            **ours(lambda: play(Canvas().draw)),
            "every cell drawn": finished(lambda: play(render)),
            "whole tiles permuted": finished(lambda: play(naive)),
            "a copy of the frames": finished(lambda: play(lambda state: frames.clone())),
            **peers[0].contender("pixels"),
            **peers[1].contender("pixels"),
        },
        "ours draws the cells that changed; 48x48 pixels here and in MiniGrid, 192x192 in navix, "
        "whose tiles are fixed",
        peers=list(peers),
    )


def env_rollout() -> Row:
    batch, steps, times = 1024, 20, 9  # scenes are drawn for some two rollouts at once
    env = PickAndPlaceEnv("move", num_envs=batch, seed=0, device=DEVICE)
    bare = PickAndPlaceEnv("move", num_envs=batch, seed=0, device=DEVICE)

    def rollout() -> float:
        for _ in range(times):
            env.rollout(steps, break_when_any_done=False)
        return batch * steps * times

    def simulate() -> float:
        for _ in range(times):
            bare._simulator.reset()
            for action in torch.randint(6, (steps, batch), device=DEVICE):
                _, terminated, truncated = bare._simulator.step(action)
                bare._simulator.pixels()
                bare._simulator.reset(terminated | truncated)
                bare._simulator.pixels()
        return batch * steps * times

    return Row(
        "PickAndPlaceEnv.rollout with resets, batch 1,024",
        "frames/s",
        {**ours(rollout), "without TensorDict": finished(simulate)},
        "a random policy, which ends every sixth episode at each step",
    )


def many_worlds(batch: int, drawn: bool) -> Row:
    simulator = Simulator(SceneOptions("move"), batch, 0, device=DEVICE)
    simulator.reset()
    actions = torch.randint(
        6, (8 * AHEAD, batch), device=DEVICE
    )  # all that is drawn ahead, and more
    action = actions[0].clone()

    def advance() -> None:
        _, terminated, truncated = simulator.step(action)
        simulator.reset(terminated | truncated)
        if drawn:
            simulator.pixels()

    def play(once: Callable[[], object]) -> float:
        for some in actions:
            action.copy_(some)
            once()
        return actions.numel()

    contenders = ours(lambda: play(advance))
    if on_gpu():
        stream, graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()
        with torch.cuda.stream(stream):
            advance()
        simulator.seed(0)
        simulator.draw_ahead()
        torch.cuda.synchronize()
        with torch.cuda.graph(graph):
            advance()

        def replay() -> None:
            simulator.draw_ahead()
            graph.replay()

        contenders = {
            **ours(lambda: play(replay)),
            "kernel by kernel": finished(lambda: play(advance)),
        }
    return Row(
        f"step, reset{' and pixels' if drawn else ''}, batch {batch:,}",
        "steps/s",
        contenders,
        "a random policy, which ends every sixth episode at each step; new scenes are drawn on the "
        "way; on a GPU a step with its reset is one CUDA graph",
    )


def gymnasium_vector() -> Row:
    batch, steps = 1024, 20
    env = gymnasium.make_vec("ifo_grounding/Move-v0", num_envs=batch, device=DEVICE)
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(6, size=(steps, batch))

    def work() -> float:
        for action in actions:
            env.step(action)
        return batch * steps

    peer = Peer("minigrid")
    return Row(
        "Gymnasium vector env, 1,024 worlds",
        "frames/s",
        {**ours(work), **peer.contender("vector")},
        "MiniGrid: SyncVectorEnv of 64 worlds, whose rate does not depend on their number",
        peers=[peer],
    )


def collector(preset: str, batch: int, steps: int) -> Row:
    coded, plain = (
        PickAndPlaceEnv("move", num_envs=batch, seed=0, device=DEVICE, codes=codes)
        for codes in (True, False)
    )
    policy = networks.make_policy(coded, preset, seed=0, device=DEVICE)

    def batches_of(env: PickAndPlaceEnv) -> Iterator[TensorDict]:
        return iter(
            Collector(
                env,
                policy,
                frames_per_batch=batch * steps,
                total_frames=-1,
                trust_policy=True,
                auto_register_policy_transforms=False,
                return_same_td=DEVICE == "cpu",  # as in self-examination, which lets go of it
            )
        )

    batches, drawn = batches_of(coded), batches_of(plain)
    observed = next(batches).select(keys.PIXELS, keys.INSTRUCTION)
    seen = [each.clone() for each in observed.unbind(1)]  # as the policy gets them, each in a row

    def collect(some: Iterator[TensorDict]) -> float:
        next(some)
        return batch * steps

    @torch.no_grad()
    def infer() -> float:
        for state in seen:
            policy(state.copy())
        return batch * steps

    return Row(
        f"Collector, preset {preset}, batch {batch:,}",
        "frames/s",
        {
            **ours(functools.partial(collect, batches)),
            "the policy alone": finished(infer),
            "drawn in pixels": finished(functools.partial(collect, drawn)),
        },
        "ours in codes, as self-examination collects; the policy alone: on the same observations",
    )


def sampler() -> Row:
    batch, sentences, candidates = 512, 500, 64
    world = PickAndPlaceEnv("pick-out", num_envs=batch, seed=0, device=DEVICE, instructed=False)
    pool = some_sentences("pick-out", sentences)
    classifier = networks.make_instruction_classifier(world, "strong", seed=0, device=DEVICE)
    # Accepts every candidate, so that a reset scores as many pairs as the bare network does.
    chooser = InstructionSampler(
        classifier, pool, threshold=0.0, candidates=candidates, choose="best"
    )
    env = TransformedEnv(world, chooser)
    pixels = world.reset()[keys.PIXELS]

    @torch.no_grad()
    def score() -> float:
        words = classifier.encode_instruction(pool)
        index = torch.randint(sentences, (batch, candidates), device=DEVICE)
        for rows in torch.arange(batch, device=DEVICE).split(32):
            classifier.score_candidates(classifier.encode_scenes(pixels[rows]), words, index[rows])
        return batch * candidates

    def reset() -> float:
        env.reset()
        return batch * candidates

    return Row(
        "reset with InstructionSampler, pool of 500",
        "pairs/s",
        {**ours(reset), "the classifier alone": finished(score)},
    )


def imitation(preset: str) -> Row:
    size, steps = (512, 12) if preset == "paper" else (4096 if on_gpu() else 256, 100)
    steps *= 20 if on_gpu() else 1  # the first ones are not of a graph
    demos, _ = record_demonstrations("move", 2000, seed=0, keep_truth=True)
    # How fast a network learns does not depend on the labels; these are random.
    actions = torch.randint(6, (demos.transitions,), dtype=torch.uint8)
    buffer = labelled_buffer(demos, actions)
    coded = PickAndPlaceEnv(device=DEVICE, codes=preset == "strong")  # as the recipe reads
    if coded.tiles is not None:
        show_codes(buffer, coded.tiles)
    buffer.transform.to(DEVICE)
    policy = networks.make_policy(coded, preset, seed=0, device=DEVICE)
    config = FitConfig(steps=steps, batch_size=size, iteration=steps, schedule="constant")

    def work() -> float:
        fit(ImitationLoss(policy), buffer, config, seed=0, cudagraph=True)
        return size * steps

    if preset == "strong":
        return Row(f"imitation, preset strong, batch {size:,}", "samples/s", ours(work))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "data.npz"
        batch = buffer.sample(4096).cpu()
        np.savez(
            path, **{name: batch[name].numpy() for name in ("pixels", "instruction", "action")}
        )
        peer = Peer("imitation", str(path), str(size), str(steps), str(torch.get_num_threads()))
    return Row(
        "imitation, preset paper, batch 512",
        "samples/s",
        {
            **ours(work),
            **peer.contender("train"),
            **peer.contender("train ours", "imitation with our layers"),
        },
        "the package imitation: BC with the same network, data and batch size, the network in plain"
        " PyTorch or of our layers, which compute what repeats once",
        peers=[peer],
    )


def labelling() -> Row:
    demos, _ = record_demonstrations("move", 4000, seed=0, keep_truth=True)
    inverse = networks.make_inverse(demos, "strong", seed=0, device=DEVICE)

    def work() -> float:
        label_demonstrations(demos, inverse)
        return demos.transitions

    return Row("labelling of demonstrations", "pairs/s", ours(work))


def random_steps() -> Row:
    env = PickAndPlaceEnv("pick", num_envs=256, seed=0, device=DEVICE, instructed=False)

    def work() -> float:
        collect_transitions(env, 20_000, seed=0)
        return 20_000

    return Row("collect_transitions", "transitions/s", ours(work))


def recording() -> Row:
    def work() -> float:
        return record_demonstrations("pick", 5000, seed=0).n_frames

    return Row("record_demonstrations, pick", "frames/s", ours(work))


def memory() -> Row:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "demonstrations"
        record_demonstrations("pick", 80_000, seed=0).save(path)
        facts = in_new_process("remember", str(path))
    return Row(
        "80,000 demonstrations of pick",
        "MB",
        {},
        note="resident memory that they add, and that imitating them adds (preset strong)",
        facts=facts,
    )


def in_new_process(function: str, *arguments: str) -> dict[str, float]:
    """Call a function of this file where nothing else has used memory."""
    ended = subprocess.run(
        [sys.executable, __file__, function, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(ended.stdout.splitlines()[-1])


def remember(path: str) -> dict[str, float]:
    """Load demonstrations and imitate them, and say what that takes."""
    start = resident_memory()
    demos = Demonstrations.load(path)
    loaded = resident_memory()
    actions = torch.randint(6, (demos.transitions,), dtype=torch.uint8)
    policy = networks.make_policy(demos, "strong", seed=0)
    config = FitConfig(steps=100, batch_size=256, iteration=50)
    fit(ImitationLoss(policy), labelled_buffer(demos, actions), config, seed=0)
    return {
        "frames": demos.n_frames,
        "MB as pixels": round(demos.n_frames * 3 * 48 * 48 / 2**20),
        "MB resident": round(loaded - start),
        "MB added by training": round(peak_memory() - loaded),
    }


def streaming() -> Row:
    return Row(
        "100,000 episodes of noise, read one by one",
        "MB",
        {},
        note="four frames of 24x24 pixels each, which do not compress and are kept on disk",
        facts=in_new_process("stream"),
    )


def stream() -> dict[str, float]:
    """Read many episodes whose frames do not compress, and say what that takes."""
    frames = (3, 3, 24, 24)  # their stop is added
    draw = np.random.default_rng(0)
    episodes = (
        (str(number), torch.from_numpy(draw.integers(256, size=frames, dtype=np.uint8)), "go on")
        for number in range(100_000)
    )
    start = resident_memory()
    demos = Demonstrations.from_episodes(episodes)
    return {
        "frames": demos.n_frames,
        "MB as pixels": round(demos.n_frames * 3 * 24 * 24 / 2**20),
        "MB resident": round(resident_memory() - start),
        "MB at most": round(peak_memory() - start),
    }


def whole(task: str, count: int) -> Row:
    """Train both phases as `ifo-grounding demo` does, from random steps to the practised policy."""
    with tempfile.TemporaryDirectory() as home:
        recipe = ROOT / "recipes" / "two_phase.py"
        options = [f"task={task}", f"demonstrations.n={count}", "run=whole", "progress=false"]
        options += [f"threads={torch.get_num_threads()}", f"device={DEVICE}"]
        subprocess.run(
            [sys.executable, str(recipe), *options],
            env={**os.environ, "IFO_GROUNDING_HOME": home},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        found = read_json(Path(home) / "runs" / "whole" / "result.json")
    seconds = sum(taken for stage, taken in found["stages"].items() if stage != "evaluate")
    success = {phase: found["results"][phase]["rate"]["rate"] for phase in ("phase1", "phase2")}
    return Row(
        f"both phases on {task}, from nothing",
        "s",
        {},
        note=f"preset strong, {count:,} demonstrations, success of 2,000 evaluation scenes",
        facts={
            "seconds, without evaluation": seconds,
            "% success, phase 1": 100 * success["phase1"],
            "% success, phase 2": 100 * success["phase2"],
        },
    )


def some_sentences(task: str, count: int) -> torch.Tensor:
    """Return token ids of different sentences of a task, [count, 16]."""
    demos = record_demonstrations(task, 3 * count, seed=0)
    pool = demos.pool()
    assert len(pool) >= count, f"{task} has {len(pool)} sentences: {grammar(task)}"
    return pool[:count].to(DEVICE)


ROWS: dict[str, Callable[[], Row]] = {
    "step": world_step,
    "pixels": world_pixels,
    "rollout": env_rollout,
    "worlds": functools.partial(many_worlds, 65_536, False),
    "worlds-pixels": functools.partial(many_worlds, 16_384, True),
    "gymnasium": gymnasium_vector,
    "collector-strong": lambda: collector("strong", 16_384 if on_gpu() else 1024, 20),
    "collector-strong-2048": functools.partial(collector, "strong", 2048, 10),
    "collector-paper": functools.partial(collector, "paper", 512, 10),
    "sampler": sampler,
    **{f"imitation-{preset}": functools.partial(imitation, preset) for preset in PRESETS},
    "labelling": labelling,
    "transitions": random_steps,
    "recording": recording,
    "memory": memory,
    "streaming": streaming,
    "whole": functools.partial(whole, "move", 3000),
    "whole-udlr": functools.partial(whole, "pick-udlr", 200),
}
ON_GPU = ("worlds", "worlds-pixels", "collector-strong", "imitation-strong", "whole-udlr")
"""Rows that are measured on a GPU where none are named."""
ON_CPU = tuple(name for name in ROWS if name != "whole-udlr")
"""Rows that are measured on a CPU where none are named."""

if __name__ == "__main__":
    called, *given = sys.argv[1:]
    print(json.dumps({"remember": remember, "stream": stream}[called](*given)))
