"""Write the report of a run: table, curves, chosen instructions and episodes, as one page."""

from pathlib import Path
from typing import Any

import torch
from _shared import (
    CLASSIFIER,
    GOAL,
    POLICIES,
    REWARD,
    chosen_by,
    command,
    load_demonstrations,
    load_network,
    load_there,
    open_run,
    world_of,
)
from evaluate import evaluate, played

from ifo_grounding.baselines.config import METHODS, REFERENCES
from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.evaluation import record_episodes, trace_episode
from ifo_grounding.files import read_record
from ifo_grounding.report import (
    animation,
    instruction_cases,
    provenance,
    reliability_diagram,
    results_rows,
    trace_animation,
    training_curves,
    write_report,
)
from ifo_grounding.report.results import conclusion, headline, meaning, restored, unpacked
from ifo_grounding.stats import Rate
from ifo_grounding.training import Run

AUDIT = {
    "Learned return and true success": {
        "audit_return": "learned return",
        "audit_success": "true success",
    },
    "True success": {"success": "greedy", "success_sampled": "sampled"},
    "Chosen instructions": {"suitable": "suitable", "served_share": "states served"},
    "Learned rewards against the truth (AUC)": {
        "return_auc": "return: success above failure",
        "action_auc": "reward: expert's action above another",
    },
    "Episode length": {"episode_length": "steps"},
    "Entropy of the policy": {"entropy": "nats"},
}
"""Reward hacking shows in the first panel: the learned return rises, and true success does not."""
CURVES: dict[str, tuple[str, Any]] = {
    "How imitation learned": ("imitate", ["loss_imitation", "accuracy"]),
    "How the instruction classifier learned": (
        "train_instruction",
        ["positive_probability", "negative_probability", "removed"],
    ),
    "How the goal classifier learned": (
        "train_goal",
        ["final_probability", "unfinished_probability"],
    ),
    "How the reward model learned": (
        "train_reward",
        ["positive_probability", "negative_probability"],
    ),
    "How self-examination went": (
        "self_examine",
        ["learned_return", "episode_length", "stopped", "entropy", "served_share", "clip_fraction"],
    ),
    "Learned return and true success (validation scenes)": ("self_examine", AUDIT),
}
EPISODES, COMPARED, TRACED = 4, 3, 2
TILE_SIZE = 32
"""Of a cell in animations, for people."""


def report(options: Options, results: dict[str, Any] | None = None) -> Path:
    """Write the page of a run, of what :func:`evaluate` has just returned or will return now."""
    run = open_run(options)
    results = evaluate(options) if results is None else results
    pictures: dict[str, Any] = episode_pictures(run, options, results)
    if "suitability" in results:
        classifier = load_network(run, CLASSIFIER, options)
        oracle, pool = world_of(options).oracle, load_demonstrations(run).pool()
        assert oracle is not None
        shown: Any = {"states": 512, "pairs_per_state": 0, "stream": "validation"}
        shown |= {"split": options.evaluate.split, **chosen_by(options)}
        chosen = oracle.suitable_rate(classifier, pool, **shown)
        pictures["Chosen instructions"] = instruction_cases(chosen, pool)
        pictures["How often random pairs are suitable, against what is said"] = reliability_diagram(
            [(said, restored(Rate, rate)) for said, rate in results["suitability"]["reliability"]]
        )
    pictures |= curves(run)
    section = options.evaluate
    scenes = section.stream if section.split == "all" else f"{section.stream}, {section.split}"
    rows = [*results_rows(results), *rivals(run, results)]
    rows = [{**row, "means": meaning(row["measured"])} for row in rows]
    return write_report(
        run / "report",
        {**headline(results), "All that was measured": rows, "How it was made": made_by(run)},
        pictures,
        title=f"{options.task}, {options.demonstrations.n:,} demonstrations",
        summary=f"{conclusion(results)} Preset {options.preset}, seed {options.seed}, "
        f"{section.episodes:,} scenes ({scenes}).",
    )


def rivals(run: Run, results: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each method of Table 1 that was measured, and is not among the results."""
    shown = [method for name, method in REFERENCES.items() if name in results]
    others = [method for method in METHODS if method not in shown]
    measured = {method: run.stage(f"evaluate_{method}").result for method in others}
    rates = {m: of["results"][m]["rate"] for m, of in measured.items() if of}
    return [
        {"measured": f"{method} (baseline), success", "result [95% interval]": restored(Rate, rate)}
        for method, rate in rates.items()
    ]


def made_by(run: Run) -> dict[str, Any]:
    """Return command and version, and how long each stage took."""
    path, known = run / "result.json", provenance()
    how = read_record(path)["command"] if path.exists() else command("report")
    version = " ".join(str(known[name]) for name in ("version", "commit") if known[name])
    took = {name: f"{record['seconds']:,.0f} s" for name, record in run.records().items()}
    return {"command": how, "version": version, **took}


def recorded(policy: Any, scenes: list[int], options: Options, tile_size: int | None) -> list:
    """Play the evaluation scenes of these numbers, to look at."""
    env, how = played(options, len(scenes))
    how.pop("episodes")  # scenes are named
    return record_episodes(policy, env, scenes, render_tile_size=tile_size, **how)


def episode_pictures(run: Run, options: Options, results: dict[str, Any]) -> dict[str, Any]:
    """Animate episodes: scenes that phase 2 gained and lost, or some of the last policy."""
    names = [name for name in POLICIES if name in results]
    policies = [load_network(run, POLICIES[name], options) for name in names]
    drawn = {"actions": world_of(options).actions}
    episodes = recorded(policies[-1], list(range(EPISODES)), options, TILE_SIZE)
    some = {f"Episodes of phase {len(policies)}": animation(episodes, columns=EPISODES, **drawn)}
    if len(policies) == 1 or results[names[0]]["mode"] != "greedy":
        # Actions that were drawn are not drawn again: what they solved, these episodes may not.
        return some | step_by_step(policies[-1], list(range(TRACED)), run, options)
    before, after = (torch.from_numpy(unpacked([{"results": results}], name)[0]) for name in names)
    found: dict[str, Any] = {}
    for title, changed in {
        "Before and after self-examination": after & ~before,
        "Solved before, and not after": before & ~after,
    }.items():
        scenes = changed.nonzero().squeeze(-1)[:COMPARED].tolist()
        if scenes:
            tries = [recorded(policy, scenes, options, TILE_SIZE) for policy in policies]
            both = [one for pair in zip(*tries, strict=True) for one in pair]
            titles = ["imitation", "self-examination"] * len(scenes)
            found[title] = animation(both, titles=titles, columns=len(policies), **drawn)
    improved = (after & ~before).nonzero().squeeze(-1)[:TRACED].tolist()
    return found | some | step_by_step(policies[1], improved or list(range(TRACED)), run, options)


def step_by_step(policy: Any, scenes: list[int], run: Run, options: Options) -> dict[str, bytes]:
    """Animate episodes with action probabilities, learned rewards and attention."""
    rewards = load_there(run, {"action": REWARD, "goal": GOAL}, options)
    words, found = load_demonstrations(run).vocabulary, {}
    for episode in recorded(policy, scenes, options, None):
        trace = trace_episode(policy, episode, rewards, vocabulary=words)
        title = f"Step by step, scene {episode.scene}"
        found[title] = trace_animation(trace, actions=world_of(options).actions)
    return found


def curves(run: Run) -> dict[str, Any]:
    """Plot what was logged, stage by stage; what was not finite was kept as null."""
    logged = {title: (run.metrics(stage), panels) for title, (stage, panels) in CURVES.items()}
    return {title: training_curves(*each) for title, each in logged.items() if each[0]}


@recipe_main
def main(options: Options) -> None:
    print(report(options))


if __name__ == "__main__":
    main()
