"""Write the report of a run: table, curves, chosen instructions and episodes, as one page."""

from pathlib import Path
from typing import Any

import torch
from _options import as_made
from _shared import (
    CLASSIFIER,
    GOAL,
    REWARD,
    load_demonstrations,
    load_network,
    open_run,
    practised_pool,
)
from _worlds import World, open_world
from evaluate import NAMES, PHASES, evaluate, evaluation_scenes
from omegaconf import DictConfig
from tensordict.nn import TensorDictModule

from ifo_grounding.cli import recipe_main
from ifo_grounding.evaluation import Rate, record_episodes, trace_episode
from ifo_grounding.files import read_json
from ifo_grounding.report import (
    animation,
    audit_figure,
    improved_episodes,
    instruction_cases,
    reliability_diagram,
    results_rows,
    success_over_iterations,
    trace_animation,
    training_curves,
    write_report,
)
from ifo_grounding.report.results import restored, unpacked
from ifo_grounding.training import Run

CURVES = {
    "imitate": ("Imitation", ["loss_imitation", "accuracy"]),
    "train_instruction": (
        "Instruction module",
        ["positive_probability", "negative_probability", "removed"],
    ),
    "train_goal": ("Goal judge", ["final_probability", "unfinished_probability"]),
    "train_reward": ("Reward module", ["positive_probability", "negative_probability"]),
    "self_examine": (
        "Self-examination",
        ["learned_return", "episode_length", "stopped", "entropy", "served_share", "clip_fraction"],
    ),
}
EPISODES, TRACED = 4, 2


def report(options: DictConfig, results: dict[str, Any] | None = None) -> Path:
    """Write the page of a run, of what :func:`evaluate` has just returned or will return now."""
    run = open_run(options)
    if results is None:
        results = evaluate(options)
    world = open_world(options)
    pictures: dict[str, Any] = episode_pictures(run, world, results)
    if "suitability" in results:
        pictures["Chosen instructions"] = instruction_cases(
            load_network(run, CLASSIFIER, "train_instruction", options),
            world.task,
            practised_pool(run, options),
            threshold=options.instruction.threshold,
            candidates=options.instruction.candidates,
            choose=options.instruction.choose,
            **world.arguments(split=options.evaluate.split, stream="validation"),
        )
        pictures["How often random pairs are suitable, against what is said"] = reliability_diagram(
            [(said, restored(Rate, rate)) for said, rate in results["suitability"]["reliability"]]
        )
    pictures |= curves(run)
    return write_report(
        run / "report",
        {"Results": results_rows(results)},
        pictures,
        title=f"{options.task}, preset {options.network}",
        summary=f"{options.demonstrations.n:,} demonstrations, seed {options.seed}, "
        f"{options.evaluate.episodes:,} evaluation scenes ({scenes_of(options)}).",
    )


def scenes_of(options: DictConfig) -> str:
    """Return which scenes are evaluated, in words."""
    stream, split = options.evaluate.stream, options.evaluate.split
    return stream if split == "all" else f"{stream}, {split} instructions"


def episode_pictures(run: Run, world: World, results: dict[str, Any]) -> dict[str, Any]:
    """Animate episodes: scenes that phase 2 gained and lost, or some of phase 1."""
    found: dict[str, Any] = {}
    policies = [
        load_network(run, file, "imitate", world.options)
        for name, file in NAMES.items()
        if name in PHASES and name in results
    ]
    where = evaluation_scenes(world.options)
    drawn: dict[str, Any] = {"actions": world.actions}
    place, shown = world.pictured(list(range(EPISODES)), **where)
    episodes = record_episodes(policies[-1], place, **shown)
    found[f"Episodes of phase {len(policies)}"] = animation(episodes, columns=EPISODES, **drawn)
    if len(policies) == 1 or results[PHASES[0]]["mode"] != "greedy":
        # Actions that were drawn are not drawn again: what they solved, these episodes may not.
        return found | step_by_step(policies[-1], list(range(TRACED)), run, world)
    before, after = (torch.from_numpy(unpacked([{"results": results}], p)[0]) for p in PHASES)
    improved = (after & ~before).nonzero().squeeze(-1)[:TRACED].tolist()
    for title, changed in {
        "Solved by phase 2 alone": after & ~before,
        "Solved by phase 1 alone": before & ~after,
    }.items():
        scenes = changed.nonzero().squeeze(-1)[:EPISODES].tolist()
        if scenes:
            place, shown = world.pictured(scenes, **where)
            tries, titles = improved_episodes(policies[0], policies[1], place, **shown)
            found[title] = animation(tries, titles=titles, columns=len(scenes), **drawn)
    return found | step_by_step(policies[1], improved or list(range(TRACED)), run, world)


def step_by_step(
    policy: TensorDictModule, scenes: list[int], run: Run, world: World
) -> dict[str, bytes]:
    """Animate episodes with action probabilities, the judges' verdicts and attention."""
    judges = {
        name: load_network(run, file, recipe, world.options)
        for name, file, recipe in (("action", REWARD, "train_reward"), ("goal", GOAL, "train_goal"))
        if run.is_current(recipe)
    }
    place, shown = world.pictured(scenes, **evaluation_scenes(world.options))
    words = load_demonstrations(run).vocabulary
    found = {}
    for episode in record_episodes(policy, place, **{**shown, "render_tile_size": None}):
        trace = trace_episode(policy, episode, judges, vocabulary=words)
        title = f"Step by step, scene {episode.scene}"
        found[title] = trace_animation(trace, actions=world.actions)
    return found


def curves(run: Run) -> dict[str, Any]:
    """Plot what was logged, stage by stage."""
    found: dict[str, Any] = {}
    for stage, (title, wanted) in CURVES.items():
        path = run / "metrics" / f"{stage}.json"
        if not path.exists() or not run.is_current(stage):
            continue
        history = read_json(path)
        logged = [name for name in wanted if any(name in row for row in history)]
        found[title] = training_curves(history, logged)
        if stage == "self_examine":
            found["Audit of self-examination (validation scenes)"] = audit_figure(history)
        audited = [row for row in history if "success" in row]
        if len(audited) > 1:
            rates = [
                Rate(row["success"], row["success_low"], row["success_high"], 0, 0)
                for row in audited
            ]
            found["Success in training (validation scenes)"] = success_over_iterations(
                [row["step"] for row in audited], rates
            )
    return found


@recipe_main
def main(options: DictConfig) -> None:
    print(report(as_made(options)))


if __name__ == "__main__":
    main()
