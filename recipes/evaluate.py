"""Evaluate what a run has trained: success, chosen instructions, labels and learned rewards."""

import sys
from collections.abc import Callable
from typing import Any

from _shared import (
    CLASSIFIER,
    CONTINUED,
    GOAL,
    POLICIES,
    REWARD,
    chosen_by,
    finish,
    load_demonstrations,
    load_network,
    load_there,
    open_run,
    open_stage,
    plain,
    world_of,
    write_result,
)

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.errors import UserError
from ifo_grounding.evaluation import (
    SuccessResult,
    compare_endings,
    compare_success,
    return_audit,
    reward_audit,
    success_rate,
)
from ifo_grounding.report import results_rows, text_table
from ifo_grounding.report.results import by_scene
from ifo_grounding.training import Run
from ifo_grounding.transforms import GoalReward, LearnedReward

NAMES = {**POLICIES, "continued": CONTINUED}
"""Policies that a run may have, by their names in the results."""
ROWS = 1000
"""Episodes that are played side by side."""
UNTIL_THE_END = 10_000
"""Worlds have limits of their own."""
HELD_OUT = 500
"""Demonstrations, none of them trained on, that the reward of actions is compared with."""
SHOWN = 200
"""The same, for the log of self-examination."""


def evaluate(options: Options) -> dict:
    run = open_run(options, "evaluate")
    there = [name for name, file in NAMES.items() if (run / file).exists()]
    asked = {"policies": there, **plain(options.evaluate), **chosen_by(options)}
    stage = open_stage(options, "evaluate", of=asked)
    if stage.result is not None:
        return stage.result["results"]
    run.need(POLICIES["phase1"], "imitate")
    if options.evaluate.split == "zero-shot" and options.world.get("split") != "train":
        print(
            "note: the demonstrations name the pairs of these scenes, too (world.split="
            f"{options.world.get('split')}): what is measured is no zero-shot success",
            file=sys.stderr,
        )
    # Each part is reported if the run has it, so that phase 1 can be evaluated alone.
    labels = run.record("label").get("result", {}).get("accuracy")
    results: dict[str, Any] = {"labels": labels} if labels else {}
    policies = load_there(run, NAMES, options)
    measured = measured_success(policies, options)
    results |= success_results(measured)
    if "phase2" in measured:
        results["gain"] = compare_success(measured["phase1"], measured["phase2"]).as_dict()
    results |= evaluate_truth(policies, run, options)
    results |= evaluate_rewards(policies["phase1"], run, options)
    finish(options, stage, {"of": asked, "results": results})
    return results


def measured_success(policies: dict[str, Any], options: Options) -> dict[str, SuccessResult]:
    """Measure success of each policy on the same evaluation scenes."""
    env, shown = played(options, options.evaluate.episodes)
    mode = options.evaluate.mode
    return {name: success_rate(each, env, mode=mode, **shown) for name, each in policies.items()}


def evaluation_scenes(options: Options) -> dict[str, Any]:
    """Return which scenes to evaluate on."""
    return {name: getattr(options.evaluate, name) for name in ("seed", "stream", "split")}


def played(options: Options, episodes: int, **chosen: Any) -> tuple[Any, dict[str, Any]]:
    """Return the instructed world of the evaluation scenes, and how to play it."""
    scenes, world = {**evaluation_scenes(options), **chosen}, world_of(options)
    if not world.rewarded:
        raise UserError(
            f"nobody knows success in this world: ifo-grounding play run={options.run} shows it"
        )
    env = world.instructed(min(episodes, ROWS), device=options.device, **scenes)
    return env, {
        "episodes": episodes,
        "max_steps": options.evaluate.max_steps or UNTIL_THE_END,
        "seed": scenes["seed"],
        "stream": scenes["stream"],
    }


def success_results(measured: dict[str, SuccessResult]) -> dict[str, Any]:
    """Return what was measured as plain values, with the success on every scene."""
    return {
        name: {**success.as_dict(), **by_scene(success.outcomes)}
        for name, success in measured.items()
    }


def evaluate_truth(policies: dict[str, Any], run: Run, options: Options) -> dict[str, Any]:
    """Say what only an oracle knows: how episodes end, and whether chosen instructions suit."""
    oracle, scenes = world_of(options).oracle, evaluation_scenes(options)
    if oracle is None:
        return {}
    phases = {name: policies[name] for name in POLICIES if name in policies}
    episodes, splits = options.evaluate.episodes, [scenes["split"]]
    splits += ["train"] if scenes["split"] == "zero-shot" else []  # beside it, trained pairs
    results: dict[str, Any] = {}
    for name, split in zip(("endings", "trained"), splits, strict=False):
        chosen = {**scenes, "split": split}
        ends = {n: oracle.endings(policy, episodes, **chosen) for n, policy in phases.items()}
        results[name] = {n: end.as_dict() for n, end in ends.items()}
        if len(ends) > 1 and name == "endings":
            results["changes"] = compare_endings(*ends.values())
    if options.evaluate.states and (run / CLASSIFIER).exists():
        classifier = load_network(run, CLASSIFIER, options)
        pool, states = load_demonstrations(run).pool(), options.evaluate.states
        chosen = {**chosen_by(options), **scenes}
        results["suitability"] = oracle.suitable_rate(
            classifier, pool, states=states, **chosen
        ).as_dict()
    return results


def evaluate_rewards(policy: Any, run: Run, options: Options) -> dict[str, Any]:
    """Compare learned rewards with the expert's actions and with the true success of rollouts."""
    results: dict[str, Any] = {}
    world, scenes = world_of(options), evaluation_scenes(options)
    env, shown = played(options, options.evaluate.audit_episodes, waits=True)
    if (run / REWARD).exists():
        model = load_network(run, REWARD, options)
        if world.oracle is not None:
            demos, truth = world.demonstrate(HELD_OUT, seed=scenes["seed"], stream=scenes["stream"])
            assert truth is not None
            results["action_reward"] = reward_audit(model, demos, truth).as_dict()
        audit = return_audit(policy, LearnedReward(model), env, average=True, **shown)
        results["action_return"] = audit.as_dict()
    if (run / GOAL).exists():
        classifier = load_network(run, GOAL, options)
        reward = GoalReward(classifier, stop_action=world.stop_action)
        results["goal_return"] = return_audit(policy, reward, env, **shown).as_dict()
    return results


def audit_callback(
    policy: Any, reward: LearnedReward | GoalReward, run: Run, options: Options
) -> Callable[[int], dict[str, float]]:
    """Return what measures a policy in training on validation scenes: for the log alone."""
    world, section = world_of(options), options.evaluate
    scenes = {"stream": "validation", "split": "all"}
    env, shown = played(options, section.audit_episodes, **scenes)
    waiting, _ = played(options, section.audit_episodes, waits=True, **scenes)
    fixed: dict[str, Any] = {}  # the classifier does not change, nor do the expert's actions
    if world.oracle is not None:
        chosen = world.oracle.suitable_rate(
            load_network(run, CLASSIFIER, options),
            load_demonstrations(run).pool(),
            states=section.audit_episodes,
            pairs_per_state=0,
            seed=section.seed,
            stream="validation",
            **chosen_by(options),
        )
        fixed["suitable"] = chosen.rate.rate
    by_action = isinstance(reward, LearnedReward) and world.oracle is not None
    shown_by_expert = (
        world.demonstrate(SHOWN, seed=section.seed, stream="validation") if by_action else None
    )

    def audit(step: int) -> dict[str, float]:
        result = success_rate(policy, env, mode="both", **shown)
        assert result.sampled is not None
        paid = return_audit(policy, reward, waiting, **shown)
        found = {
            "success": result.rate.rate,
            "success_low": result.rate.low,
            "success_high": result.rate.high,
            "success_sampled": result.sampled.rate.rate,
            "success_stopped": result.stopped.rate,
            "audit_return": float(paid.returns.mean()),
            "audit_success": paid.success.rate,
            "return_auc": paid.auc.value,
        }
        if shown_by_expert is not None:
            demos, truth = shown_by_expert
            assert isinstance(reward, LearnedReward) and truth is not None
            found["action_auc"] = reward_audit(reward.model, demos, truth).auc.value
        return {**found, **fixed}

    return audit


@recipe_main
def main(options: Options) -> dict:
    results = evaluate(options)
    write_result(options, results, "evaluate")
    print(text_table(results_rows(results)))
    return results


if __name__ == "__main__":
    main()
