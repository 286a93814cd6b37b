"""Record demonstrations, or read what others recorded: frames and instructions, never actions."""

from typing import Any

from _shared import DEMONSTRATIONS, TRUTH, finish, open_stage, tell, world_of
from torchrl.envs.utils import RandomPolicy

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.errors import UserError, check_names_of_actions
from ifo_grounding.evaluation import success_rate
from ifo_grounding.worlds import World

SCENES = 4
"""Scenes in which a world is tried out."""


def record(options: Options) -> dict:
    stage = open_stage(options, "record_demonstrations")
    if stage.result is not None:
        return stage.result
    world, n = world_of(options), options.demonstrations.n
    if options.recorded:
        demos, truth = world.read(options.recorded, progress=options.progress)[:n], None
    else:
        demos, truth = world.demonstrate(n, seed=options.seed, progress=options.progress)
    if world.rewarded:
        world.vocabulary = world.vocabulary or demos.vocabulary
        try_out(world, options.seed)
    if truth is not None:
        truth.save(stage.run / TRUTH)
    demos.save(stage.run / DEMONSTRATIONS)
    counts = {"demonstrations": len(demos), "transitions": demos.transitions}
    return finish(options, stage, {**counts, "instructions": len(demos.pool())})


def try_out(world: World, seed: int) -> None:
    """Step in instructed scenes, so that what is wrong with them is said before training.

    Raises:
        UserError: where none can begin, where one seed shows several scenes, or where the names of
            actions are not as many as the actions.
    """
    env = world.instructed(1, seed=seed, stream="validation")
    if world.actions and hasattr(env.action_spec, "n"):
        check_names_of_actions(world.actions, env.action_spec.n)
    shown: Any = {"episodes": SCENES, "stream": "validation", "max_steps": 1}
    random = RandomPolicy(env.action_spec)
    first, again = (success_rate(random, env, **shown).scenes for _ in range(2))
    if first != again:
        raise UserError(
            "the world shows other scenes each time it is given the same seed: let its reset draw "
            "from that seed alone (in Gymnasium: super().reset(seed=seed), then self.np_random)"
        )


@recipe_main
def main(options: Options) -> None:
    tell(record(options))


if __name__ == "__main__":
    main()
