"""Write the networks of a run as folders with model cards, for others to use."""

from pathlib import Path

from _shared import (
    CLASSIFIER,
    GOAL,
    INVERSE,
    POLICIES,
    REWARD,
    load_demonstrations,
    load_network,
    open_run,
)
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main
from ifo_grounding.files import read_json
from ifo_grounding.networks import save_pretrained
from ifo_grounding.report import results_rows
from ifo_grounding.training import Run

FILES = {
    "policy": POLICIES,
    "inverse": (INVERSE,),
    "instruction": (CLASSIFIER,),
    "reward": (REWARD,),
    "goal": (GOAL,),
}
"""Files of each network; the last one that a run has is the one to share."""


def share(options: DictConfig) -> list[Path]:
    run = open_run(options)
    run.need(POLICIES[0], "imitate")
    demos = load_demonstrations(run)
    facts = card_facts(run)
    written = []
    for name, files in FILES.items():
        present = [file for file in files if (run / file).exists()]
        if present:
            network = load_network(run, present[-1], "two_phase", options)
            hub_id = f"{options.hub}-{name}" if options.hub else None
            folder = Path(options.to) / name
            written.append(
                save_pretrained(
                    network, folder, vocabulary=demos.vocabulary, facts=facts, hub_id=hub_id
                )
            )
    return written


def card_facts(run: Run) -> dict[str, object]:
    """Return what a model card says of a run: task, data, results, and the command."""
    path = run / "result.json"
    if not path.exists():
        return {}
    found = read_json(path)
    options = found["options"]
    results = {
        row["measured"]: row["result [95% interval]"] for row in results_rows(found["results"])
    }
    return {
        "Task": options["task"],
        "Demonstrations": f"{options['demonstrations']['n']:,}",
        "Seed": options["seed"],
        **results,
        "Command": f"`{found['command']}`",
        "Commit": found["provenance"]["commit"],
    }


@recipe_main
def main(options: DictConfig) -> None:
    for folder in share(options):
        print(folder)


if __name__ == "__main__":
    main()
