"""Label the demonstrations with the inverse model (paper, 1st-phase)."""

from typing import Any

from _shared import (
    INVERSE,
    LABELS,
    TRUTH,
    finish,
    load_demonstrations,
    load_network,
    open_stage,
    world_of,
)

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.data import Truth, label_demonstrations
from ifo_grounding.evaluation import label_accuracy
from ifo_grounding.report import results_rows, text_table


def label(options: Options) -> dict:
    stage = open_stage(options, "label")
    if stage.result is not None:
        return stage.result
    demos = load_demonstrations(stage.run)
    inverse = load_network(stage.run, INVERSE, options)
    _, report = label_demonstrations(demos, inverse, progress=options.progress)
    report.save(stage.run / LABELS)
    found: dict[str, Any] = {"confidence": report.summary()}
    # Only the evaluation reads the truth: nothing of it goes back into training.
    if (stage.run / TRUTH).exists():  # demonstrations that were recorded elsewhere have none
        truth = Truth.load(stage.run / TRUTH)
        accuracy = label_accuracy(report.actions, truth, names=world_of(options).actions)
        found["accuracy"] = accuracy.as_dict()
    return finish(options, stage, found)


@recipe_main
def main(options: Options) -> None:
    found = label(options)
    if "accuracy" in found:
        print(text_table(results_rows({"labels": found["accuracy"]})))
    else:
        names = world_of(options).actions
        rows = [{**row, "action": names[row["action"]]} for row in found["confidence"]]
        print("confidence of the labels", text_table(rows), sep="\n")


if __name__ == "__main__":
    main()
