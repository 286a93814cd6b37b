"""Record demonstrations, or read what others recorded: frames and instructions, never actions."""

import sys
import zlib
from pathlib import Path
from typing import Any

import torch
from _shared import DEMONSTRATIONS, TRUTH, finish, open_stage, tell, world_of
from torch import Tensor
from torchrl.envs.utils import RandomPolicy

from ifo_grounding.cli import recipe_main
from ifo_grounding.config import Options
from ifo_grounding.data import Demonstrations
from ifo_grounding.distinct import hash_rows, words_of
from ifo_grounding.errors import UserError, check_names_of_actions
from ifo_grounding.evaluation import success_rate
from ifo_grounding.keys import PIXELS
from ifo_grounding.worlds import World

SCENES = 4
"""Scenes in which a world is tried out."""
SHOWN = 32
"""First frames whose colours are compared, of recordings and of the simulator."""
TOLERATED = 0.1
"""Share of the recorded pixels that may be of colours new to the simulator."""


def record(options: Options) -> dict:
    stage = open_stage(options, "record_demonstrations")
    if stage.result is not None:
        if read := stage.result.get("read"):
            refuse_changed(options, read)
        return stage.result
    world, n = world_of(options), options.demonstrations.n
    found: dict[str, Any] = {}
    if options.recorded:
        found["read"] = content_of(options.recorded)
        every, truth = world.read(options.recorded, progress=options.progress), None
        demos = every[:n]
        if len(demos) < len(every):
            print(f"note: {n} of {len(every)} recorded demonstrations: demonstrations.n takes more")
        compare_colours(world, demos.first_frames()[:SHOWN], options.seed)
    else:
        made: Any = world.demonstrate(n, seed=options.seed, progress=options.progress)
        if not (isinstance(made, tuple) and len(made) == 2 and isinstance(made[0], Demonstrations)):
            raise UserError(
                f"{type(world).__name__}.demonstrate returned {type(made).__name__}: let it return "
                "Demonstrations and their Truth, or None in its place"
            )
        demos, truth = made
        world.vocabulary = world.vocabulary or demos.vocabulary
        if demos.image_shape != (shown := world.image_shape("simulator", seed=0)):
            raise UserError(
                f"demonstrations show images of {list(demos.image_shape)}, the simulator of "
                f"{list(shown)}: let it show the same"
            )
    if world.rewarded:
        try_out(world, options.seed)
    if truth is not None:
        truth.save(stage.run / TRUTH)
    demos.save(stage.run / DEMONSTRATIONS)
    found |= {"demonstrations": len(demos), "transitions": demos.transitions}
    return finish(options, stage, {**found, "instructions": len(demos.pool())})


def content_of(folder: str) -> str:
    """Say how much a folder of recordings holds, by which a change of it shows."""
    found = [path for each in Path(folder).iterdir() for path in (each, *each.rglob("*"))]
    files = sorted(path for path in found if path.is_file() and not path.name.startswith("."))
    checksum = 0
    for path in files:  # lists as a whole: of sentences, or of checksums of what is saved
        said = path.read_bytes() if path.suffix in (".json", ".jsonl") else b""
        name = f"{path.relative_to(folder)} {path.stat().st_size}".encode()
        checksum = zlib.crc32(name + said, checksum)
    return f"{len(files):,} files of checksum {checksum:08x}"


def refuse_changed(options: Options, read: str) -> None:
    """Refuse a folder of recordings that holds other files than were read, where it is there."""
    folder = str(options.recorded)
    if Path(folder).exists() and (now := content_of(folder)) != read:
        raise UserError(
            f"{folder} held {read} when the run {options.run} read it, and holds {now}: give "
            "another run="
        )


def try_out(world: World, seed: int) -> None:
    """Step in instructed scenes, so that what is wrong with them is said before training.

    Raises:
        UserError: where none can begin, where one seed shows several scenes, or where the names of
            actions are not as many as the actions.
    """
    world.image_shape("instructed", seed=seed, stream="validation")
    env = world.instructed(1, seed=seed, stream="validation")
    if hasattr(env.action_spec, "n"):
        check_names_of_actions(world.actions, env.action_spec.n)
    shown: Any = {"episodes": SCENES, "stream": "validation", "max_steps": 1}
    random = RandomPolicy(env.action_spec)
    first, again = (success_rate(random, env, **shown).scenes for _ in range(2))
    if first != again:
        raise UserError(
            "the world shows other scenes each time it is given the same seed: let its reset draw "
            "from that seed alone (in Gymnasium: super().reset(seed=seed), then self.np_random)"
        )


def compare_colours(world: World, frames: Tensor, seed: int) -> None:
    """Say so where frames [N, C, H, W] have many colours that the simulator does not show."""
    shown = world.simulator(2 * SHOWN, seed=seed).reset()[PIXELS].cpu()
    known, more = colours(shown[:SHOWN]), colours(shown[SHOWN:])
    others, own = ((~torch.isin(each, known)).float().mean() for each in (colours(frames), more))
    if others > own + TOLERATED:
        print(
            f"note: {others:.0%} of the recorded pixels have colours that the simulator does not "
            "show (grey pictures, JPEG, videos): what imitates one may fail in the other",
            file=sys.stderr,
        )


def colours(frames: Tensor) -> Tensor:
    """Return a number for the colour of each pixel of frames [N, C, H, W], int64 [N * H * W]."""
    return hash_rows(words_of(frames.movedim(1, -1).flatten(0, 2)))


@recipe_main
def main(options: Options) -> None:
    tell(record(options))


if __name__ == "__main__":
    main()
