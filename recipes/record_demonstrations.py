"""Record demonstrations, or read what others recorded: frames and instructions, never actions."""

from _shared import DEMONSTRATIONS, TRUTH, finish, open_stage, tell, world_of

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options


def record(options: Options) -> dict:
    stage = open_stage(options, "record_demonstrations")
    if stage.result is not None:
        return stage.result
    world, n = world_of(options), options.demonstrations.n
    if options.recorded:
        demos, truth = world.read(options.recorded, progress=options.progress)[:n], None
    else:
        demos, truth = world.demonstrate(n, seed=options.seed, progress=options.progress)
    if truth is not None:
        truth.save(stage.run / TRUTH)
    demos.save(stage.run / DEMONSTRATIONS)
    counts = {"demonstrations": len(demos), "transitions": demos.transitions}
    return finish(options, stage, {**counts, "instructions": len(demos.pool())})


@recipe_main
def main(options: Options) -> None:
    tell(record(options))


if __name__ == "__main__":
    main()
