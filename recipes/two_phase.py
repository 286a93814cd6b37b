"""Both phases on one task, and a report: the main job."""

from _options import check
from _results import write_result
from _shared import MADE, open_run, plain
from collect_transitions import collect
from evaluate import evaluate
from imitate import imitate
from label import label
from omegaconf import DictConfig
from record_demonstrations import record
from self_examine import examine
from train_goal import train_goal
from train_instruction import train_instruction
from train_inverse import train_inverse
from train_reward import train_reward

from ifo_grounding.cli import recipe_main
from ifo_grounding.files import write_json
from ifo_grounding.report import results_table
from report import report


def two_phase(options: DictConfig) -> dict:
    train_phases(options)
    results = evaluate(options)
    write_result(options, results, "demo")
    return results


def train_phases(options: DictConfig) -> None:
    check(options)  # first, for a new run takes over what its base has made
    run = open_run(options)
    if not run.begun:
        write_json(run / MADE, plain(options))
    make_phases(options)
    write_json(run / MADE, plain(options))  # now that all of it was made with these


def make_phases(options: DictConfig) -> None:
    # Phase 1: imitation from observation.
    record(options)  # first, for they hold the words of worlds with a vocabulary of their own
    collect(options)
    train_inverse(options)
    label(options)
    imitate(options)
    if not options.phase2:
        return
    # Phase 2: self-examination.
    train_instruction(options)
    if options.self_examine.kind != "goal":
        train_reward(options)
    if options.self_examine.kind != "action":
        train_goal(options)
    if options.practise:
        examine(options)


@recipe_main
def main(options: DictConfig) -> None:
    results = two_phase(options)
    page = report(options, results)
    print(f"\n{results_table(results)}\n\nrun: {open_run(options).folder}\nreport: {page}")


if __name__ == "__main__":
    main()
