"""Write the networks of a run as folders with model cards, for others to use."""

from pathlib import Path

from _shared import CLASSIFIER, GOAL, INVERSE, POLICIES, REWARD, load_network, open_run

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.files import read_record
from ifo_grounding.networks import save_pretrained
from ifo_grounding.report import results_rows
from ifo_grounding.training import Run

FILES = {
    "policy": (POLICIES["phase2"], POLICIES["phase1"]),
    "inverse": (INVERSE,),
    "instruction": (CLASSIFIER,),
    "reward": (REWARD,),
    "goal": (GOAL,),
}
"""Files of each network; the first that is there is shared."""


def share(options: Options) -> list[Path]:
    run = open_run(options, "share")
    facts, written = card_facts(run, options), []
    for name, files in FILES.items():
        there = [file for file in files if (run / file).exists()]
        if there:
            network = load_network(run, there[0], options)
            hub_id = f"{options.hub}-{name}" if options.hub else None
            folder = Path(options.to) / name
            written.append(save_pretrained(network, folder, facts=facts, hub_id=hub_id))
    return written


def card_facts(run: Run, options: Options) -> dict[str, object]:
    """Return what a model card says of a run: task, data, results, and the command."""
    facts: dict[str, object] = {
        "Task": options.task,
        "Demonstrations": f"{options.demonstrations.n:,}",
        "Seed": options.seed,
    }
    if (run / "result.json").exists():
        written = read_record(run / "result.json")
        rows = results_rows(written["results"])
        facts |= {row["measured"]: row["result [95% interval]"] for row in rows}
        facts["Command"] = f"`{written['command']}`"
        facts["Commit"] = written["provenance"]["commit"]
    return facts


@recipe_main
def main(options: Options) -> None:
    for folder in share(options):
        print(folder)


if __name__ == "__main__":
    main()
