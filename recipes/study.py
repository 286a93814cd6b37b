"""One seed of a comparison: both phases and both controls, on the same evaluation scenes.

python recipes/study.py task=move budget=study demonstrations.n=1000 seed=0 results=results/study
"""

from _results import check_result, keep_result, write_result
from _shared import open_run, settle_demonstrations
from controls import run_controls
from evaluate import evaluate
from omegaconf import DictConfig
from references import references
from two_phase import train_phases

from ifo_grounding.cli import recipe_main
from ifo_grounding.files import read_json
from ifo_grounding.report import results_table
from ifo_grounding.report.audit import PANELS


def study(options: DictConfig) -> dict:
    settle_demonstrations(options)  # of which its file is named
    check_result(options)
    train_phases(options)
    practised = options.phase2 and options.practise
    if practised and options.controls.run:
        run_controls(options)
    results = evaluate(options)
    if options.references:
        results = {**results, **references(options)}
    content = write_result(options, results, "run study")
    if practised:
        content["audit"] = audit(options)
    keep_result(options, content)
    return results


def audit(options: DictConfig) -> list[dict[str, float]]:
    """Return of every iteration of phase 2 what the picture of the audit shows, where it is known.

    An area under a curve is not, where every episode of an audit succeeds.
    """
    shown = {"step", *(name for lines in PANELS.values() for name in lines)}
    history = read_json(open_run(options) / "metrics" / "self_examine.json")
    return [
        {k: round(v, 5) for k, v in row.items() if k in shown and v is not None} for row in history
    ]


@recipe_main
def main(options: DictConfig) -> None:
    print(results_table(study(options)))


if __name__ == "__main__":
    main()
