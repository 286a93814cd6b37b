"""What phase 1 is measured against: imitation of the true actions, and the demonstrator itself.

No learner of observation-only demonstrations may read these actions: a reference, not a method.
"""

from _options import as_made
from _shared import REFERENCE, TRUTH, load_demonstrations, load_network, open_stage
from _worlds import open_world
from evaluate import measured_success, success_results
from imitate import imitate_transitions, split_transitions
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import Truth
from ifo_grounding.errors import UserError
from ifo_grounding.report import results_table
from ifo_grounding.report.results import by_scene


def references(options: DictConfig) -> dict:
    imitate_truth(options)
    stage = open_stage(options, "evaluate_references", ["evaluate"], needs=["imitate_truth"])
    if stage.result is not None:
        return stage.result
    policy = load_network(stage.run, REFERENCE, "references", options)
    world, section = open_world(options), options.evaluate
    results = success_results(measured_success({"true_actions": policy}, world))
    solved = world.demonstrator(section.episodes, seed=section.seed, stream=section.stream)
    results["demonstrator"] = by_scene(solved)
    return stage.finish(results)


def imitate_truth(options: DictConfig) -> dict:
    """Imitate as phase 1 does, with the demonstrator's actions in place of labels."""
    stage = open_stage(options, "imitate_truth", ["imitate"], needs=["record_demonstrations"])
    if stage.result is not None:
        return stage.result
    demos = load_demonstrations(stage.run)
    if not (stage.run / TRUTH).exists():
        raise UserError(
            f"{stage.run / TRUTH} is missing: demonstrations that were recorded elsewhere hold no "
            "actions, and have no references"
        )
    truth = Truth.load(stage.run / TRUTH)
    seen, held_out = split_transitions(demos, truth.actions, options.imitate.held_out)
    return imitate_transitions(options, stage, seen, held_out, REFERENCE)


@recipe_main
def main(options: DictConfig) -> None:
    print(results_table(references(as_made(options))))


if __name__ == "__main__":
    main()
