"""Record demonstrations, or read what others recorded: frames and instructions, never actions."""

import shutil

from _shared import DEMONSTRATIONS, TRUTH, open_stage, shows_progress, tell
from _worlds import open_world, read_recorded
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main


def record(options: DictConfig) -> dict:
    decisive = ["demonstrations", *(["recorded"] if options.recorded else [])]
    stage = open_stage(options, "record_demonstrations", decisive, needs=[])
    if stage.result is not None:
        return stage.result
    if options.recorded:
        demos, truth = read_recorded(options), None
    else:
        demos, truth = open_world(options).demonstrate(
            options.demonstrations.n, seed=options.seed, progress=shows_progress(options)
        )
    stage.replace()
    demos.save(stage.run / DEMONSTRATIONS)
    if truth is None:
        shutil.rmtree(stage.run / TRUTH, ignore_errors=True)  # of others, recorded before
    else:
        truth.save(stage.run / TRUTH)
    counts = {"demonstrations": len(demos), "transitions": demos.transitions}
    return stage.finish({**counts, "instructions": len(demos.pool())})


@recipe_main
def main(options: DictConfig) -> None:
    tell(record(options))


if __name__ == "__main__":
    main()
