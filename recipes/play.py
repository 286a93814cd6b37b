"""A page on which one watches a trained agent, talks to it and teaches it; or one scene as a GIF.

python recipes/play.py run=move-strong-demo-seed0
python recipes/play.py to=play.gif scene=7 sentence="move to the red diamond"
"""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from _shared import (
    CLASSIFIER,
    GOAL,
    INVERSE,
    POLICIES,
    VALUE,
    load_demonstrations,
    load_there,
    world_of,
)
from hydra.core.config_store import ConfigStore

from ifo_grounding.cli import recipe_main
from ifo_grounding.errors import UserError, check_choice, check_range
from ifo_grounding.files import atomic_write
from ifo_grounding.networks import from_pretrained
from ifo_grounding.networks.hub import OWN
from ifo_grounding.options import options_of
from ifo_grounding.playground import Agent, Source, taught_in
from ifo_grounding.tasks import TASKS, grammar
from ifo_grounding.texts import one_line
from ifo_grounding.training import Run


@dataclass
class PlayOptions:
    """What is played."""

    task: str | None = None
    """With the networks that come with the package: ``move``, where no ``run`` is named,
    ``move-udlr``, ``pick``, ``pick-out`` or ``pick-udlr``."""
    run: str | None = None
    """A run whose networks are played, in its world; null takes those of the package."""
    host: str = "127.0.0.1"
    """Address that the page listens on; another than this machine's own lets others in."""
    port: int = 7860
    """Port that the page listens on."""
    browser: bool = True
    """Whether the page is opened in a browser."""
    to: str | None = None
    """Instead of opening a page, plays one scene and writes an animation of it to this GIF."""
    scene: int = 0
    """With ``to``: number of the scene."""
    sentence: str | None = None
    """With ``to``: what is asked; null takes the scene's own instruction."""
    seed: int = 0
    """With ``to``: seed of the scenes."""

    def __post_init__(self) -> None:
        check_choice("task", "move" if self.task is None else self.task, TASKS)
        if self.task and self.run:
            raise UserError("task= is for networks of the package: give it, or run=, not both")
        check_range(self, "scene", "seed", least=0, most=2**31)
        check_range(self, "port", least=1, most=65_535)
        if self.to is not None and Path(self.to).suffix.lower() != ".gif":
            raise UserError(f"to= names a GIF, not {self.to}: give it a name that ends in .gif")
        if self.to is None and (self.sentence is not None or self.scene or self.seed):
            raise UserError("scene, sentence and seed are for one animation: give to=play.gif, too")


ConfigStore.instance().store(name="play_options", node=PlayOptions)


def play(options: PlayOptions) -> dict[str, Any]:
    """Play one scene, and return what happened."""
    agent = load(named(options))
    *_, played = agent.play(options.scene, options.seed, options.sentence).values()
    episode, actions = played.trace.episode, agent.world.actions
    first = torch.from_numpy(episode.frames[0])
    suited = agent.suits(episode.sentence, first, options.scene, options.seed)
    found: dict[str, Any] = {"scene": options.scene, "asked": episode.sentence}
    found["suits, by the instruction classifier"] = suited.probability
    found["suits, in truth"] = suited.truth
    found["done"] = " ".join(actions[action] for action in episode.actions)
    found["fulfilled, by the goal classifier"] = played.fulfilled
    if played.success is not None:
        found["fulfilled, in truth"] = "yes" if played.success else "no"
    from ifo_grounding.report import trace_animation  # draws: slow to import

    with atomic_write(str(options.to)) as temporary:
        temporary.write_bytes(trace_animation(played.trace, actions=actions))
    found["step by step"] = options.to
    return {name: value for name, value in found.items() if value is not None}


def named(options: PlayOptions) -> str:
    """Return the name of the networks that are played."""
    return options.run or f"{OWN}/{options.task or 'move'}"


@functools.lru_cache(maxsize=8)
def load(name: str) -> Agent:
    """Return the networks of the package, ``ifo-grounding/TASK``, or those of a run."""
    if name.startswith(f"{OWN}/"):
        own = {kind: from_pretrained(name, kind=kind) for kind in ("instruction", "goal", "policy")}
        policies = {"self-examination": own.pop("policy")}
        world = world_of(options_of(f"task={name.removeprefix(OWN + '/')}"))
        return Agent(world, policies, grammar(world.task).tokens, **own)
    run = Run(name)
    if run.options() is None:
        raise UserError(f"there is no run {name} ({run.folder}): ifo-grounding demo makes one")
    made = options_of(f"run={name}")
    run.need(POLICIES["phase1"], "imitate")
    phases = dict(zip(("imitation", "self-examination"), POLICIES.values(), strict=True))
    others = {"instruction": CLASSIFIER, "goal": GOAL, "value": VALUE, "inverse": INVERSE}
    policies, others = (load_there(run, files, made) for files in (phases, others))
    agent = Agent(world_of(made), policies, load_demonstrations(run).pool(), **others)
    return agent if agent.arranges else replace(agent, teach=taught_in(made.world))


@recipe_main
def main(options: PlayOptions) -> None:
    if options.to is None:
        from ifo_grounding.playground.page import LOCAL, open_page

        names = (named(options), *(f"{OWN}/{task}" for task in TASKS))
        source = Source(load, tuple(dict.fromkeys(names)), local=options.host == LOCAL)
        open_page(source, options.host, options.port, options.browser)
        return
    found = play(options)
    width = max(map(len, found))
    for name, value in found.items():
        shown = f"{value:.0%}" if isinstance(value, float) else one_line(value)
        print(f"{name:<{width}}  {shown}")


if __name__ == "__main__":
    main()
