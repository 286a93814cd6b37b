"""Evaluate what a run has trained: success, chosen instructions, labels and judges."""

import sys
from typing import Any

from _options import OF_EVALUATION, as_made
from _results import keep_result, write_result
from _shared import (
    CLASSIFIER,
    CONTROLS,
    GOAL,
    POLICIES,
    REWARD,
    load_network,
    need_phase_1,
    open_stage,
    practised_pool,
)
from _worlds import Grid, World, open_world
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main
from ifo_grounding.evaluation import (
    Endings,
    SuccessResult,
    compare_endings,
    compare_success,
    episode_endings,
    return_correlation,
    reward_audit,
    success_rate,
    suitable_rate,
)
from ifo_grounding.report import results_table
from ifo_grounding.report.results import packed
from ifo_grounding.training import Run
from ifo_grounding.transforms import LearnedReward

PHASES = ("phase1", "phase2")
NAMES = dict(zip((*PHASES, "continued", "cloned"), (*POLICIES, *CONTROLS), strict=True))
"""Policies that a run may have, by their names in the results."""
STAGES = dict(
    zip(NAMES, ("imitate", "self_examine", "continue_imitation", "clone_accepted"), strict=True)
)
"""The stage that makes each; one whose phase 1 was made anew since belongs to another policy."""
HELD_OUT = 500
"""Demonstrations, none of them trained on, that the action reward is compared with."""


def evaluate(options: DictConfig) -> dict:
    phases = ["label", "imitate", "train_instruction", "train_reward", "train_goal", "self_examine"]
    controls = ["continue_imitation", "clone_accepted"]
    stage = open_stage(options, "evaluate", list(OF_EVALUATION), needs=[*phases, *controls])
    if stage.result is not None:
        return stage.result
    run = stage.run
    need_phase_1(run)
    named = options.world.get("split")
    if options.evaluate.split == "zero-shot" and named != "train":
        print(
            f"note: the demonstrations name the pairs of these scenes, too (world.split={named}): "
            "what is measured is no zero-shot success",
            file=sys.stderr,
        )
    # Each part is reported if the run has it, so that phase 1 can be evaluated alone.
    labels = run.record("label")["result"].get("accuracy")
    results: dict[str, Any] = {"labels": labels} if labels else {}
    there = [name for name, file in NAMES.items() if (run / file).exists()]
    current = [name for name in there if run.is_current(STAGES[name])]
    for name in sorted({*there} - {*current}):
        recipe = "controls" if NAMES[name] in CONTROLS else STAGES[name]
        print(
            f"note: {name} builds on what was made anew since, and is left out: run the recipe "
            f"{recipe} again",
            file=sys.stderr,
        )
    policies = {name: load_network(run, NAMES[name], "imitate", options) for name in current}
    world = open_world(options)
    results |= evaluate_policies(policies, world)
    if world.oracle:
        results |= evaluate_endings(policies, world)
        if options.evaluate.states and run.is_current("train_instruction"):
            results["suitability"] = evaluate_choices(run, world)
    results |= evaluate_judges(policies["phase1"], run, world)
    return stage.finish(results)


def evaluate_policies(policies: dict[str, Any], world: World) -> dict[str, Any]:
    """Measure success of each policy on the same fixed scenes, and the gain of phase 2."""
    measured = measured_success(policies, world)
    results = success_results(measured)
    if "phase2" in measured:
        results["gain"] = compare_success(measured["phase1"], measured["phase2"]).as_dict()
    return results


def measured_success(policies: dict[str, Any], world: World) -> dict[str, SuccessResult]:
    """Measure success of each policy on the evaluation scenes."""
    section = world.options.evaluate
    place, shown = world.played(section.episodes, **evaluation_scenes(world.options))
    return {
        name: success_rate(policy, place, mode=section.mode, **shown)
        for name, policy in policies.items()
    }


def success_results(measured: dict[str, SuccessResult]) -> dict[str, Any]:
    """Return what was measured as plain values, with the success on every scene."""
    return {
        name: {**success.as_dict(), "outcomes": packed(success.outcomes)}
        for name, success in measured.items()
    }


def evaluate_endings(policies: dict[str, Any], world: Grid) -> dict[str, Any]:
    """Say how the greedy episodes of each phase end, and what phase 2 changes.

    Of a zero-shot evaluation, the same of instructions that name trained pairs alone.
    """
    shown = evaluation_scenes(world.options)
    phases = {name: policies[name] for name in PHASES if name in policies}

    def endings(**scenes: Any) -> dict[str, Endings]:
        task, options = world.played(world.options.evaluate.episodes, **scenes)
        return {n: episode_endings(p, task, **options) for n, p in phases.items()}

    found = endings(**shown)
    results: dict[str, Any] = {"endings": {name: end.as_dict() for name, end in found.items()}}
    if len(found) > 1:
        results["changes"] = compare_endings(*found.values())
    if shown["split"] == "zero-shot":
        trained = endings(**{**shown, "split": "train"})
        results["trained"] = {name: end.as_dict() for name, end in trained.items()}
    return results


def evaluate_choices(run: Run, world: Grid) -> dict[str, Any]:
    """Let the oracle judge the instructions that the instruction module chooses."""
    options, section = world.options, world.options.instruction
    result = suitable_rate(
        load_network(run, CLASSIFIER, "train_instruction", options),
        world.task,
        practised_pool(run, options),
        states=options.evaluate.states,
        threshold=section.threshold,
        candidates=section.candidates,
        choose=section.choose,
        **world.arguments(**evaluation_scenes(options)),
    )
    return result.as_dict()


def evaluate_judges(policy: Any, run: Run, world: World) -> dict[str, Any]:
    """Compare the judges with the expert's actions and with the true success of rollouts."""
    results: dict[str, Any] = {}
    options = world.options
    audited = evaluation_scenes(options)
    place, shown = world.played(options.evaluate.audit_episodes, waits=True, **audited)
    if run.is_current("train_reward"):
        judge = load_network(run, REWARD, "train_reward", options)
        if world.oracle:
            demos, truth = world.demonstrate(HELD_OUT, **audited)
            results["action_reward"] = reward_audit(judge, demos, truth).as_dict()
        audit = return_correlation(policy, LearnedReward(judge), place, average=True, **shown)
        results["action_return"] = audit.as_dict()
    if run.is_current("train_goal"):
        judge = load_network(run, GOAL, "train_goal", options)
        reward = LearnedReward(judge, "goal", stop_action=world.stop)
        results["goal_return"] = return_correlation(policy, reward, place, **shown).as_dict()
    return results


def evaluation_scenes(options: DictConfig) -> dict[str, Any]:
    """Return which scenes to evaluate on."""
    return {name: options.evaluate[name] for name in ("seed", "stream", "split")}


@recipe_main
def main(options: DictConfig) -> None:
    options = as_made(options)
    results = evaluate(options)
    if options.results:
        keep_result(options, write_result(options, results, "evaluate"))
    print(results_table(results))


if __name__ == "__main__":
    main()
