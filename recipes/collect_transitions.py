"""Step the simulator at random: what the inverse model learns from (paper, 1st-phase)."""

from _shared import TRANSITIONS, finish, open_stage, simulator_of, tell, world_of

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.data import collect_transitions


def collect(options: Options) -> dict:
    stage = open_stage(options, "collect_transitions")
    if stage.result is not None:
        return stage.result
    section, stop = options.transitions, world_of(options).stop_action
    collected = collect_transitions(
        simulator_of(options, section.num_envs),
        section.n,
        stop_probability=None if stop is None else section.stop_probability,
        stop_action=stop,
        seed=options.seed,
        progress=options.progress,
    )
    collected.save(stage.run / TRANSITIONS)
    counts = {name: getattr(collected.report, name).tolist() for name in ("taken", "kept")}
    return finish(options, stage, counts)


@recipe_main
def main(options: Options) -> None:
    tell(collect(options))


if __name__ == "__main__":
    main()
