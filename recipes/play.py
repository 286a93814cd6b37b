"""One scene and one sentence: what a trained policy does, and what was learned thinks of it.

python recipes/play.py task=move scene=7 sentence="move to the red circle"
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from _shared import CLASSIFIER, GOAL, POLICIES, load_network, world_of
from hydra.core.config_store import ConfigStore
from tensordict import TensorDict

from ifo_grounding import keys
from ifo_grounding.cli import recipe_main
from ifo_grounding.errors import UserError, check_choice, check_range
from ifo_grounding.evaluation import record_episodes, trace_episode
from ifo_grounding.files import atomic_write
from ifo_grounding.modules import evaluating
from ifo_grounding.networks import from_pretrained
from ifo_grounding.options import options_of
from ifo_grounding.seeding import STREAMS
from ifo_grounding.tasks import TASKS
from ifo_grounding.training import Run
from ifo_grounding.worlds import World


@dataclass
class PlayOptions:
    """What is played."""

    task: str = "move"
    """With the networks that come with the package: ``move``, ``move-udlr``, ``pick``,
    ``pick-out`` or ``pick-udlr``."""
    run: str | None = None
    """A run whose networks are played, in its world; null takes those of the package."""
    scene: int = 0
    """Number of the scene."""
    sentence: str | None = None
    """What is asked; null takes the scene's own instruction."""
    stream: str = "evaluation"
    """Scenes of ``evaluation``, ``validation`` or ``training``."""
    seed: int = 0
    """Of the scenes."""
    to: str | None = "play.gif"
    """Animation that is written, step by step; null writes none."""

    def __post_init__(self) -> None:
        check_choice("task", self.task, TASKS)
        check_choice("stream", self.stream, STREAMS)
        check_range(self, "scene", "seed", least=0, most=2**31)
        if self.to is not None and Path(self.to).suffix.lower() != ".gif":
            raise UserError(f"to={self.to} is a GIF: give it a name that ends in .gif")


ConfigStore.instance().store(name="play_options", node=PlayOptions)


def play(options: PlayOptions) -> dict[str, Any]:
    """Play the scene, and return what happened."""
    networks, world = trained(options)
    policy = networks["policy"]
    env = world.instructed(1, seed=options.seed, stream=options.stream)
    how: dict[str, Any] = {"seed": options.seed, "stream": options.stream}
    (episode,) = record_episodes(policy, env, [options.scene], sentence=options.sentence, **how)
    found: dict[str, Any] = {"scene": options.scene, "asked": episode.sentence}
    frames = torch.from_numpy(episode.frames)
    said = policy.vocabulary.encode([episode.sentence])
    seen = {keys.PIXELS: frames[:1], keys.INSTRUCTION: said}
    if "instruction" in networks:
        found["suits, by the instruction classifier"] = asked(networks["instruction"], seen)
    if world.oracle is not None:
        found["suits, in truth"] = world.oracle.suits(said[0], options.scene, **how)
    found["done"] = " ".join(world.actions[action] for action in episode.actions)
    seen |= {keys.INITIAL_PIXELS: frames[:1], keys.PIXELS: frames[-1:]}
    if "goal" in networks:
        found["fulfilled, by the goal classifier"] = asked(networks["goal"], seen)
    found["fulfilled, in truth"] = "yes" if episode.success else "no"
    if options.to:
        from ifo_grounding.report import trace_animation  # draws: slow to import

        trace = trace_episode(policy, episode, vocabulary=policy.vocabulary)
        with atomic_write(options.to) as temporary:
            temporary.write_bytes(trace_animation(trace, actions=world.actions))
        found["step by step"] = options.to
    return found


def trained(options: PlayOptions) -> tuple[dict[str, Any], World]:
    """Return the networks that are played, and their world."""
    if options.run is None:
        kinds = ("policy", "instruction", "goal")
        of = f"ifo-grounding/{options.task}"
        world = world_of(options_of(f"task={options.task}"))
        return {kind: from_pretrained(of, kind=kind) for kind in kinds}, world
    run = Run(options.run)
    if run.options() is None:
        raise UserError(
            f"there is no run {options.run} ({run.folder}): ifo-grounding demo makes one"
        )
    made = options_of(f"run={options.run}")
    files = {"policy": POLICIES["phase2"], "instruction": CLASSIFIER, "goal": GOAL}
    if not (run / files["policy"]).exists():
        files["policy"] = POLICIES["phase1"]
    there = {kind: file for kind, file in files.items() if (run / file).exists()}
    there["policy"] = files["policy"]
    networks = {kind: load_network(run, file, "imitate", made) for kind, file in there.items()}
    return networks, world_of(made)


@torch.no_grad()
def asked(network: Any, seen: dict[str, Any]) -> str:
    """Return the probability that a classifier gives one frame, with its instruction."""
    with evaluating(network):
        logit = network(TensorDict(seen, [1]).select(*network.in_keys))[network.out_keys[0]]
    return f"{float(logit.sigmoid()):.0%}"


@recipe_main
def main(options: PlayOptions) -> None:
    found = play(options)
    width = max(map(len, found))
    for name, value in found.items():
        print(f"{name:<{width}}  {value}")


if __name__ == "__main__":
    main()
