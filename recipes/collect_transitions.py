"""Step the simulator at random: what the inverse module learns from (paper, 1st-phase)."""

from _shared import RANDOM_STEPS, open_stage, shows_progress, tell
from _worlds import open_world
from omegaconf import DictConfig

from ifo_grounding.cli import recipe_main
from ifo_grounding.data import collect_transitions


def collect(options: DictConfig) -> dict:
    stage = open_stage(options, "collect_transitions", ["transitions"], needs=[])
    if stage.result is not None:
        return stage.result
    section, world = options.transitions, open_world(options)
    collected = collect_transitions(
        world.simulator(section.num_envs),
        section.n,
        stop_probability=section.stop_probability,
        stop_action=world.stop,
        drop_unchanged=section.drop_unchanged,
        seed=options.seed,
        progress=shows_progress(options),
    )
    stage.replace()
    collected.save(stage.run / RANDOM_STEPS)
    counts = {name: getattr(collected.report, name).tolist() for name in ("taken", "kept")}
    return stage.finish(counts)


@recipe_main
def main(options: DictConfig) -> None:
    tell(collect(options))


if __name__ == "__main__":
    main()
