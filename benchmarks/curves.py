"""Whether speed costs success: ``python benchmarks/curves.py`` learns with and without it.

Imitation of the true actions of 3,000 demonstrations of ``move``, preset ``strong``: cells that
look alike are computed once, as on any CPU, or each by itself. Writes
``results/bench/curves.json``.
"""

from __future__ import annotations

import time
from unittest import mock

import torch
from measuring import ROOT

from ifo_grounding import networks
from ifo_grounding.data import labelled_buffer, record_demonstrations
from ifo_grounding.evaluation import compare_success, success_rate
from ifo_grounding.files import write_json
from ifo_grounding.networks import patches
from ifo_grounding.objectives import ImitationLoss
from ifo_grounding.report import provenance
from ifo_grounding.training import FitConfig, fit

CONFIG = FitConfig(steps=300, batch_size=256, lr=4e-3, iteration=25, warmup=0.1, weight_decay=0.01)
SEED = 0


def main() -> None:
    torch.set_flush_denormal(True)
    demos, truth = record_demonstrations("move", 3000, seed=SEED, keep_truth=True)
    found, successes = {}, []
    for name, shared in (("cells that look alike once", True), ("each cell by itself", False)):
        policy = networks.make_policy(demos, "strong", seed=SEED)
        start = time.perf_counter()
        with mock.patch.object(patches, "is_plain", patches.is_plain if shared else no):
            buffer = labelled_buffer(demos, truth.actions)
            history = fit(ImitationLoss(policy), buffer, CONFIG, seed=SEED)
        seconds = time.perf_counter() - start
        success = success_rate(policy, "move", episodes=5000, stream="validation", seed=SEED)
        successes.append(success)
        found[name] = {
            "loss": [round(row["loss_imitation"], 4) for row in history],
            "accuracy": [round(row["accuracy"], 4) for row in history],
            "success": success.rate.as_dict(),
            "seconds": round(seconds, 1),
        }
        print(name, found[name])
    difference = compare_success(*successes).as_dict()
    content = {"seed": SEED, "provenance": provenance(), "found": found, "difference": difference}
    write_json(ROOT / "results" / "bench" / "curves.json", content)


def no(image: torch.Tensor) -> bool:
    """Say that no image is one of which parts are shared."""
    return False


if __name__ == "__main__":
    main()
