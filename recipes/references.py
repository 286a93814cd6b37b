"""What phase 1 is measured against: imitation of the true actions, and the demonstrator itself.

No learner of observation-only demonstrations may read these actions: a reference, not a method.
"""

from _shared import (
    REFERENCE,
    TRUTH,
    finish,
    load_demonstrations,
    load_network,
    open_stage,
    world_of,
)
from evaluate import measured_success, success_results
from imitate import imitate_transitions, split_transitions

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.data import Truth
from ifo_grounding.errors import UserError
from ifo_grounding.report import results_table
from ifo_grounding.report.results import by_scene


def references(options: Options) -> dict:
    imitate_truth(options)
    stage, section = open_stage(options, "evaluate_references"), options.evaluate
    policy = load_network(stage.run, REFERENCE, "references", options)
    results = success_results(measured_success({"true_actions": policy}, options))
    solved = world_of(options).demonstrator(
        section.episodes, seed=section.seed, stream=section.stream
    )
    results["demonstrator"] = by_scene(solved)
    return finish(options, stage, results)


def imitate_truth(options: Options) -> dict:
    """Imitate as phase 1 does, with the demonstrator's actions in place of labels."""
    stage = open_stage(options, "imitate_truth")
    if stage.result is not None:
        return stage.result
    if not (stage.run / TRUTH).exists():
        raise UserError(
            f"{stage.run / TRUTH} is missing: demonstrations that were recorded elsewhere hold no "
            "actions, and have no references"
        )
    demos, truth = load_demonstrations(stage.run), Truth.load(stage.run / TRUTH)
    seen, held_out = split_transitions(demos, truth.actions, options.imitate.held_out)
    return imitate_transitions(options, stage, seen, held_out, REFERENCE)


@recipe_main
def main(options: Options) -> None:
    print(results_table(references(options)))


if __name__ == "__main__":
    main()
