"""Whether speed costs success: ``python benchmarks/curves.py`` learns with and without it.

Imitation of the true actions of 3,000 demonstrations of ``move``, preset ``strong``: cells that
look alike are computed once, as on any CPU, or each by itself, as for images of floats. Writes
``results/bench/curves.json``.
"""

from __future__ import annotations

import time

import torch
from measuring import ROOT
from tensordict import TensorDictBase

from ifo_grounding import keys, networks
from ifo_grounding.data import labelled_buffer, record_demonstrations
from ifo_grounding.evaluation import success_rate
from ifo_grounding.files import write_json
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.report import provenance
from ifo_grounding.stats import paired_difference, rate_over_seeds
from ifo_grounding.training import FitConfig, fit

CONFIG = FitConfig(steps=300, batch_size=256, lr=4e-3, iteration=25, weight_decay=0.01)
SEEDS = range(5)
WAYS = ("cells that look alike once", "each cell by itself")


def main() -> None:
    torch.set_flush_denormal(True)
    found = {way: [learn(way, seed) for seed in SEEDS] for way in WAYS}
    outcomes = [torch.stack([each.pop("outcomes") for each in found[way]]) for way in WAYS]
    content = {
        "provenance": provenance(),
        "found": found,
        "success": [rate_over_seeds(each).as_dict() for each in outcomes],
        "difference": paired_difference(*reversed(outcomes)).as_dict(),
    }
    write_json(ROOT / "results" / "bench" / "curves.json", content)


def learn(way: str, seed: int) -> dict:
    """Learn with one seed, and return the curve, the success on each scene and the time."""
    demos, truth = record_demonstrations("move", 3000, seed=seed, keep_truth=True)
    policy = networks.make_policy(demos, "strong", seed=seed)
    buffer = labelled_buffer(demos, truth.actions)
    if way == WAYS[1]:
        buffer.append_transform(floats)
    start = time.perf_counter()
    history = fit(ImitationLoss(policy), buffer, CONFIG, seed=seed)
    seconds = time.perf_counter() - start
    success = success_rate(policy, "move", episodes=5000, stream="validation", seed=0)
    print(way, seed, success, f"{seconds:.1f} s", flush=True)
    return {
        "seed": seed,
        "loss": [round(row["loss_imitation"], 4) for row in history],
        "seconds": round(seconds, 1),
        "outcomes": success.outcomes,
    }


def floats(batch: TensorDictBase) -> TensorDictBase:
    """Make images floats, of which nothing is computed once for several cells."""
    return batch.set(keys.PIXELS, batch[keys.PIXELS] / 255)


if __name__ == "__main__":
    main()
