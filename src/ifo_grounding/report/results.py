"""The results of one run as a table, whether they were just measured or read from a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

from ifo_grounding.files import read_json
from ifo_grounding.report.tables import folded, text_table
from ifo_grounding.stats import Difference, Estimate, Rate, wilson

REFERENCES = {"true_actions": "imitation of true actions", "demonstrator": "demonstrator"}
"""What no learner can or may be, by its name in the results."""
CONTROLS = {"continued": "imitation continued", "cloned": "accepted rollouts cloned"}
"""What phase 2 has to beat, by its name in the results."""
Measured = TypeVar("Measured", Rate, Estimate, Difference)
Key = TypeVar("Key", bound=Hashable)


def results_rows(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return one row per measurement of a run, in the order of the pipeline.

    Args:
        results: what the recipe ``evaluate`` measured, as plain values; what is missing is left
            out.

    >>> from ifo_grounding.stats import wilson
    >>> rows = results_rows({"labels": {"rate": wilson(9, 10).as_dict(), "worst": "P",
    ...     "per_action": {"P": wilson(1, 2).as_dict()}}})
    >>> [row["measured"] for row in rows]
    ['inverse accuracy', 'inverse accuracy, worst action (P)']
    """
    rows: list[dict[str, Any]] = []

    def add(measured: str, value: Any) -> None:
        rows.append({"measured": measured, "result [95% interval]": value})

    if labels := results.get("labels"):
        worst = labels["worst"]
        add("inverse accuracy", restored(Rate, labels["rate"]))
        add(
            f"inverse accuracy, worst action ({worst})", restored(Rate, labels["per_action"][worst])
        )
    for phase in (1, 2):
        if success := results.get(f"phase{phase}"):
            add(f"phase {phase} success, {success['mode']}", restored(Rate, success["rate"]))
            if sampled := success.get("sampled"):
                add(f"phase {phase} success, sampled", restored(Rate, sampled["rate"]))
    for name, title in CONTROLS.items():
        if success := results.get(name):
            add(f"{title}, success (control)", restored(Rate, success["rate"]))
    if gain := results.get("gain"):
        add("phase 2 - phase 1, paired, points", restored(Difference, gain))
    for name, title in REFERENCES.items():
        if success := results.get(name):
            add(f"{title}, success (reference)", restored(Rate, success["rate"]))
    if choices := results.get("suitability"):
        add("suitable rate of chosen instructions", restored(Rate, choices["rate"]))
        add("states served", restored(Rate, choices["served"]))
        if "servable" in choices:
            add("states that an instruction suits", restored(Rate, choices["servable"]))
        add("recall of suitable pairs", restored(Rate, choices["recall"]))
    if reward := results.get("action_reward"):
        add("action reward against the expert, AUC", restored(Estimate, reward["auc"]))
    for kind in ("action", "goal"):
        if audit := results.get(f"{kind}_return"):
            add(f"{kind} return against true success, AUC", restored(Estimate, audit["auc"]))
    return rows


def restored(kind: type[Measured], values: Mapping[str, Any]) -> Measured:
    """Return a measurement that was written as plain values, where None is undefined.

    >>> print(restored(Rate, {"rate": None, "low": 0.0, "high": 1.0, "successes": 0, "count": 0}))
    undefined (n=0)
    """
    known: dict[str, Any] = {
        key: math.nan if value is None else value for key, value in values.items()
    }
    return kind(**known)


def brief(value: Measured) -> str:
    """Return a measurement with its interval alone, in percent or points.

    >>> from ifo_grounding.stats import wilson
    >>> brief(wilson(9, 10))
    '90.0% [59.6, 98.2]'
    """
    return str(value).rpartition(" (")[0].replace(" points", "")


def effective(section: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a section that have an effect: one trial is none.

    >>> effective({"steps": 300, "trials": 1, "trial_steps": 50})
    {'steps': 300}
    """
    alone = ("trials", "trial_steps", "trial_halvings") if section.get("trials", 1) == 1 else ()
    return {name: value for name, value in section.items() if name not in alone}


def packed(outcomes: Tensor) -> str:
    """Return the success of each scene, bool [N], as hexadecimal digits of four scenes each."""
    return np.packbits(outcomes.numpy()).tobytes().hex()


def by_scene(outcomes: Tensor) -> dict[str, Any]:
    """Return the rate of success and the success of each scene, bool [N], as plain values.

    >>> import torch
    >>> found = by_scene(torch.tensor([True, False, True]))
    >>> found["rate"]["successes"], found["outcomes"]
    (2, 'a0')
    """
    rate = wilson(int(outcomes.sum()), len(outcomes))
    return {"rate": rate.as_dict(), "outcomes": packed(outcomes)}


def unpacked(runs: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    """Return the success of a policy on every scene of several runs, bool [runs, scenes].

    Args:
        runs: result files, whose scenes are the same.
        name: of the policy in their results.

    >>> import torch
    >>> bits = packed(torch.tensor([True, False, True]))
    >>> unpacked([{"results": {"phase1": {"outcomes": bits, "rate": {"count": 3}}}}], "phase1")
    array([[ True, False,  True]])
    """
    rows = []
    for run in runs:
        result = run["results"][name]
        bits = np.unpackbits(np.frombuffer(bytes.fromhex(result["outcomes"]), np.uint8))
        rows.append(bits[: result["rate"]["count"]].astype(bool))
    return np.stack(rows)


def read_results(
    folder: Path, by: Callable[[Mapping[str, Any]], Key]
) -> dict[Key, list[dict[str, Any]]]:
    """Read the result files of a folder, in the order of their names: the seeds of each study.

    Args:
        folder: of ``.json`` files.
        by: says of the options of a run to which study it belongs.
    """
    found: dict[Key, list[dict[str, Any]]] = {}
    for path in sorted(folder.glob("*.json")):
        run = read_json(path)
        found.setdefault(by(run["options"]), []).append(run)
    return found


def same_policy(run: Mapping[str, Any], name: str) -> bool:
    """Whether another policy of a run is the one of phase 1: what came after was not kept.

    >>> run = {"results": {"phase1": {"mean_length": 5.0}, "phase2": {"mean_length": 5.0}}}
    >>> same_policy(run, "phase2")
    True
    """
    results = run["results"]
    return results[name] == results["phase1"]


def commands_note(groups: Iterable[Sequence[Mapping[str, Any]]]) -> str:
    """Return by which command each run was made, at which commit, as a note that is folded away.

    >>> run = {"command": "ifo-grounding run study", "provenance": {"commit": "abc"}}
    >>> commands_note([[run]]).splitlines()[-1].strip()
    '- `ifo-grounding run study` (commit `abc`)'
    """
    made = [f"- `{run['command']}` ({_made_by(run)})" for runs in groups for run in runs]
    return folded("Commands", list(dict.fromkeys(made)))


def _made_by(run: Mapping[str, Any]) -> str:
    made = run["provenance"]
    commit = f"commit `{made['commit']}`"
    return f"{commit}; {made['renamed']}" if "renamed" in made else commit


def results_table(results: Mapping[str, Any]) -> str:
    """Return :func:`results_rows` as a table for the terminal."""
    return text_table(results_rows(results))
