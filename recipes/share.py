"""Write the networks of a run as folders with model cards, for others to use."""

from pathlib import Path

from _options import as_made
from _shared import (
    CLASSIFIER,
    GOAL,
    INVERSE,
    POLICIES,
    REWARD,
    load_demonstrations,
    load_network,
    need_phase_1,
    open_run,
    plain,
)
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main
from ifo_grounding.files import read_json
from ifo_grounding.networks import save_pretrained
from ifo_grounding.report import results_rows
from ifo_grounding.training import Run

FILES = {
    "policy": {"self_examine": POLICIES[1], "imitate": POLICIES[0]},
    "inverse": {"train_inverse": INVERSE},
    "instruction": {"train_instruction": CLASSIFIER},
    "reward": {"train_reward": REWARD},
    "goal": {"train_goal": GOAL},
}
"""Files of each network by the stage that makes them; the first that is current is shared."""


def share(options: DictConfig) -> list[Path]:
    run = open_run(options)
    need_phase_1(run)
    demos = load_demonstrations(run)
    facts = card_facts(run, options)
    written = []
    for name, files in FILES.items():
        current = [file for made_by, file in files.items() if run.is_current(made_by)]
        if current:
            network = load_network(run, current[0], "two_phase", options)
            hub_id = f"{options.hub}-{name}" if options.hub else None
            folder = Path(options.to) / name
            written.append(
                save_pretrained(
                    network, folder, vocabulary=demos.vocabulary, facts=facts, hub_id=hub_id
                )
            )
    return written


def card_facts(run: Run, options: DictConfig) -> dict[str, object]:
    """Return what a model card says of a run: task, data, results, and the command.

    Nothing where the results are those of networks that were made anew since.
    """
    if not run.is_current("evaluate"):
        return {}
    measured = run.record("evaluate")["result"]
    path = run / "result.json"
    written = read_json(path) if path.exists() else {}
    made = written.get("options") or plain(options)
    facts: dict[str, object] = {
        "Task": made["task"],
        "Demonstrations": f"{made['demonstrations']['n']:,}",
        "Seed": made["seed"],
        **{row["measured"]: row["result [95% interval]"] for row in results_rows(measured)},
    }
    if written.get("results") == measured:
        facts["Command"] = f"`{written['command']}`"
        facts["Commit"] = written["provenance"]["commit"]
    return facts


@recipe_main
def main(options: DictConfig) -> None:
    for folder in share(as_made(options)):
        print(folder)


if __name__ == "__main__":
    main()
