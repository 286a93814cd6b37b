"""Options as a whole: refused before a run begins, and those that a finished run was made with."""

from collections.abc import Sequence
from typing import Any

from _learning import fit_config, self_examination_config
from _shared import OF_CHOICE, RUNNING, changed_networks, check_same, made_with, plain
from _values import check_values
from _worlds import Grid, open_world
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from ifo_grounding.episodes import MODES
from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.networks import NetworkConfig
from ifo_grounding.networks.config import KINDS as NETWORKS
from ifo_grounding.objectives.instruction import UNLABELLED
from ifo_grounding.seeding import STREAMS
from ifo_grounding.tasks import SPLITS
from ifo_grounding.training import Run
from ifo_grounding.transforms.choosing import check_options
from ifo_grounding.transforms.reward import FORMS, KINDS

LEARNED = ("inverse", "imitate", "instruction", "reward", "goal")
"""Sections that say how a network learns."""
OF_A_COMMAND = ("run", "base", "results", "variant", *RUNNING)
"""Options that say nothing about what a run has learned."""
OF_EVALUATION = ("evaluate", *OF_CHOICE, "self_examine.recombine")
"""Options that may be others when what was learned is evaluated."""
GROUPS = {"preset": ["network"], "world": ["simulator", "world"]}
"""Choices of several options at once, and what they decide of what was learned."""


def check(options: DictConfig) -> None:
    """Refuse before a run begins what a later stage would, after hours perhaps.

    Raises:
        UserError: on a value that its stage would refuse.
    """
    check_values(options)
    world = open_world(options)
    if options.recorded and options.references:
        raise UserError("recorded demonstrations hold no actions: leave references=true out")
    if isinstance(world, Grid):  # others need the words of their demonstrations first
        world.simulator()
    for section in LEARNED:
        fit_config(options[section])
    self_examination_config(options.self_examine)
    section = options.evaluate
    check_choice("evaluate.mode", section.mode, [*MODES, "both"])
    check_choice("evaluate.stream", section.stream, STREAMS)
    check_choice("evaluate.split", section.split, SPLITS)
    chosen = options.instruction
    check_options(chosen.threshold, chosen.candidates, chosen.choose)
    check_choice("instruction.unlabelled", chosen.unlabelled, UNLABELLED)
    check_choice("self_examine.kind", options.self_examine.kind, KINDS)
    check_choice("self_examine.form", options.self_examine.form, FORMS)
    for kind in NETWORKS:
        NetworkConfig.of(kind, options.network, **changed_networks(options))


def as_made(options: DictConfig) -> DictConfig:
    """Return the options that the run of a command was made with, but for what the command names.

    Without, a run that was made with other options than the defaults would be taken for another.

    Raises:
        UserError: where the command names what contradicts how the run was made.
    """
    named = [name.lstrip("+~").split("=")[0] for name in HydraConfig.get().overrides.task]
    made = made_with(Run(options.run))
    return merged(options, made, named) if made else options


def merged(options: DictConfig, made: dict[str, Any], named: Sequence[str]) -> DictConfig:
    """Return the options ``made``, but for those of a command and what it names."""
    here = plain(options)
    result = OmegaConf.create({**here, **made})  # what is new since has today's value
    result.evaluate = OmegaConf.merge(here["evaluate"], made["evaluate"])
    for name in [*OF_A_COMMAND, *named]:
        value = plain(OmegaConf.select(options, name))
        if name in OF_A_COMMAND or name.startswith(OF_EVALUATION):
            OmegaConf.update(result, name, value, merge=False)
        elif name == "budget":
            result.evaluate = here["evaluate"]
        elif not name.startswith("hydra"):
            for decided in GROUPS.get(name, [name]):
                there = plain(OmegaConf.select(result, decided))
                check_same(options, decided, there, f"leave {decided} out")
    return result
