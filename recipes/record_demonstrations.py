"""Record demonstrations: frames and instructions, never actions."""

from _shared import DEMONSTRATIONS, TRUTH, open_stage, shows_progress, tell
from _worlds import open_world
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main


def record(options: DictConfig) -> dict:
    stage = open_stage(options, "record_demonstrations", ["demonstrations"], needs=[])
    if stage.result is not None:
        return stage.result
    demos, truth = open_world(options).demonstrate(
        options.demonstrations.n, seed=options.seed, progress=shows_progress(options)
    )
    demos.save(stage.run / DEMONSTRATIONS)
    truth.save(stage.run / TRUTH)
    counts = {"demonstrations": len(demos), "transitions": demos.transitions}
    return stage.finish({**counts, "instructions": len(demos.pool())})


@recipe_main
def main(options: DictConfig) -> None:
    tell(record(options))


if __name__ == "__main__":
    main()
