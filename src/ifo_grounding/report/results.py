"""The results of one run as a table, whether they were just measured or read from a file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

from ifo_grounding.report.tables import text_table
from ifo_grounding.stats import (
    Difference,
    Estimate,
    Rate,
    paired_difference,
    rate_over_seeds,
    wilson,
)

COMPARED = {
    "continued": "imitation continued, success (control)",
    "true_actions": "imitation of true actions, success (reference)",
    "demonstrator": "demonstrator, success (reference)",
}
"""What phase 2 is compared with, by its name in the results."""
MEANINGS = {
    "inverse": "labelled actions that are the demonstrator's own",
    "phase": "evaluation scenes in which the policy does what it is told",
    "phase 2 -": "what self-examination changed, scene by scene",
    "imitation": "the same for the policy that phase 2 is compared with",
    "demonstrator": "the same for the demonstrator",
    "suitable": "chosen instructions that make sense in their scene",
    "states": "scenes for which an instruction was chosen, or could be",
    "recall": "instructions that make sense and are found to",
    "action": "how often the better one of two is paid more (0.5: as often as by chance)",
    "goal": "how often a success is paid more than a failure (0.5: as often as by chance)",
}
"""What rows of results mean, by how they begin."""
Measured = TypeVar("Measured", Rate, Estimate, Difference)


def results_rows(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return one row per measurement of a run, in the order of the pipeline.

    Args:
        results: plain values that the recipe ``evaluate`` measured; missing ones are left out.

    >>> from ifo_grounding.stats import wilson
    >>> results_rows({"suitability": {"served": wilson(9, 10).as_dict()}})[0]["measured"]
    'states served'
    """
    return [
        {"measured": measured, "result [95% interval]": restored(kind, values)}
        for measured, kind, values in _measurements(results)
        if values is not None
    ]


def _measurements(results: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, kind and plain values of each measurement; None where it was not made."""
    if labels := results.get("labels"):
        yield "inverse accuracy", Rate, labels["rate"]
        worst = labels["worst"]
        yield f"inverse accuracy, worst action ({worst})", Rate, labels["per_action"][worst]
    for phase in (1, 2):
        if success := results.get(f"phase{phase}"):
            yield f"phase {phase} success, {success['mode']}", Rate, success["rate"]
            sampled = success.get("sampled") or {}
            yield f"phase {phase} success, sampled", Rate, sampled.get("rate")
    yield "phase 2 - phase 1, paired, points", Difference, results.get("gain")
    for name, title in COMPARED.items():
        yield title, Rate, results.get(name, {}).get("rate")
    choices = results.get("suitability") or {}
    yield "suitable rate of chosen instructions", Rate, choices.get("rate")
    yield "states served", Rate, choices.get("served")
    yield "states that an instruction suits", Rate, choices.get("servable")
    yield "recall of suitable pairs", Rate, choices.get("recall")
    for name, title in {
        "action_reward": "action reward against the expert, AUC",
        "action_return": "action return against true success, AUC",
        "goal_return": "goal return against true success, AUC",
    }.items():
        yield title, Estimate, (results.get(name) or {}).get("auc")


def meaning(measured: str) -> str:
    """Return what a row of results means, nothing where that is not said."""
    names = [name for name in MEANINGS if measured.startswith(name)]
    return MEANINGS[max(names)] if names else ""


def headline(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return what one looks for first: success of both phases, their difference, and suitability.

    >>> from ifo_grounding.stats import wilson
    >>> print(headline({"phase1": {"rate": wilson(9, 10).as_dict()}})["Imitation (phase 1)"])
    90.0% [59.6, 98.2] (n=10)
    """
    rows = {
        "Imitation (phase 1)": (Rate, results.get("phase1", {}).get("rate")),
        "After self-examination (phase 2)": (Rate, results.get("phase2", {}).get("rate")),
        "Difference": (Difference, results.get("gain")),
        "Imitation continued": (Rate, results.get("continued", {}).get("rate")),
        "Chosen instructions that suit": (Rate, (results.get("suitability") or {}).get("rate")),
    }
    return {name: restored(*row) for name, row in rows.items() if row[1] and row[1]["count"]}


def conclusion(results: Mapping[str, Any]) -> str:
    """Return in one sentence what a run found; results as for :func:`results_rows`."""
    names = [name for name in ("phase1", "phase2") if name in results]
    before, *after = (percent(restored(Rate, results[name]["rate"])) for name in names)
    if not after:
        return f"Imitation does what it is told in {before} of the scenes; there is no phase 2."
    if results["phase2"] == results["phase1"]:
        return f"No checkpoint of phase 2 beat imitation, which is kept: {before} of the scenes."
    gain = restored(Difference, results["gain"])
    chance = "; the difference may be chance" if gain.low <= 0 <= gain.high else ""
    return (
        f"Imitation does what it is told in {before} of unseen scenes; after practice on its own "
        f"signals alone, the agent does in {after[0]}{chance}."
    )


def percent(rate: Rate) -> str:
    """Return a rate in percent, without its interval."""
    return str(rate).partition(" ")[0]


def seeds_table(runs: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """Return means and intervals over runs, each the name of a row and what was measured.

    These are both phases, where a run has them, or what else was measured scene by scene.
    """
    groups: dict[tuple[str, tuple[str, ...]], list[dict[str, Any]]] = {}
    for name, results in runs:
        found = [n for n, of in results.items() if isinstance(of, Mapping) and "outcomes" in of]
        phases = [n for n in ("phase1", "phase2") if n in found]
        groups.setdefault((name, tuple(phases or found)), []).append({"results": results})
    rows = []
    for (name, there), same in groups.items():
        solved = [unpacked(same, phase) for phase in there]
        row: dict[str, Any] = {"runs": name, "seeds": len(same)}
        row |= {p: brief(rate_over_seeds(s)) for p, s in zip(there, solved, strict=True)}
        gain = {"gain, points": brief(paired_difference(*solved))} if solved[1:] else {}
        rows.append(row | gain)
    return text_table(rows)


def restored(kind: type[Measured], values: Mapping[str, Any]) -> Measured:
    """Return a measurement that was written as plain values, where None is undefined.

    >>> print(restored(Rate, {"rate": None, "low": 0.0, "high": 1.0, "successes": 0, "count": 0}))
    undefined (n=0)
    """
    known: Any = {key: math.nan if value is None else value for key, value in values.items()}
    return kind(**known)


def brief(value: Measured) -> str:
    """Return a measurement with its interval alone, in percent or points.

    >>> from ifo_grounding.stats import wilson
    >>> brief(wilson(9, 10))
    '90.0% [59.6, 98.2]'
    """
    return str(value).rpartition(" (")[0].replace(" points", "")


def by_scene(outcomes: Tensor) -> dict[str, Any]:
    """Return the rate of success and the success of each scene, bool [N], as plain values.

    Scenes are hexadecimal digits of four each.

    >>> import torch
    >>> found = by_scene(torch.tensor([True, False, True]))
    >>> found["rate"]["successes"], found["outcomes"]
    (2, 'a0')
    """
    rate = wilson(int(outcomes.sum()), len(outcomes))
    return {"rate": rate.as_dict(), "outcomes": np.packbits(outcomes.numpy()).tobytes().hex()}


def unpacked(runs: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    """Return the success of a policy on every scene of several result files, bool [runs, scenes].

    >>> import torch
    >>> found = by_scene(torch.tensor([True, False, True]))
    >>> unpacked([{"results": {"phase1": found}}], "phase1")
    array([[ True, False,  True]])
    """
    rows = []
    for run in runs:
        result = run["results"][name]
        bits = np.unpackbits(np.frombuffer(bytes.fromhex(result["outcomes"]), np.uint8))
        rows.append(bits[: result["rate"]["count"]].astype(bool))
    return np.stack(rows)
