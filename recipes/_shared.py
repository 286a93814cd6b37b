"""What every recipe needs: the run, its stages, what they left, and how to tell of it."""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from _values import check_values, count_held_out
from omegaconf import DictConfig, OmegaConf
from torchrl import torchrl_logger

from ifo_grounding import networks
from ifo_grounding.allocation import keep_freed_memory, release_freed_memory
from ifo_grounding.data import Demonstrations, LabelReport
from ifo_grounding.data.listing import LIST, read_list
from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json, write_json
from ifo_grounding.machine import machine_of
from ifo_grounding.report import format_cell, text_table
from ifo_grounding.training.run import Run, Stage

torchrl_logger.setLevel("WARNING")

RANDOM_STEPS = "transitions"
DEMONSTRATIONS = "demonstrations"
TRUTH = "truth"
LABELS = "labels"
INVERSE = "inverse.safetensors"
POLICIES = ("policy-phase1.safetensors", "policy-phase2.safetensors")
CONTROLS = ("policy-continued.safetensors", "policy-cloned.safetensors")
REFERENCE = "reference-true-actions.safetensors"
CLASSIFIER = "instruction.safetensors"
REWARD = "reward.safetensors"
GOAL = "goal.safetensors"
OF_LOOKS = ("evaluate", "evaluate_references")
"""Stages that look at what a run has made."""
PLACE = ("task", "simulator")
"""Options that all stages of a run share."""
OF_CHOICE = ("instruction.threshold", "instruction.candidates", "instruction.choose")
"""Options that decide which instructions are chosen, and nothing of what chooses."""
RUNNING = ("checkpoint_seconds", "logger", "progress", "threads", "device")
"""Options that decide no result."""
MADE = "options.json"
"""Options that a run was made with."""
MACHINES = "machines.json"
"""On which machines its stages were done."""
PHASE_2 = (
    "self_examine",
    "continue_imitation",
    "clone_accepted",
    "evaluate",
    POLICIES[1],
    *CONTROLS,
)
"""Stages and networks that a run makes anew where it takes over another's phase 1."""


def fewer(number: int, than: int, value: Any, otherwise: Any) -> Any:
    """Return a value where a number is below another; in options ``${fewer:number,than,...}``.

    >>> fewer(200, 1000, 64, 256)
    64
    """
    return value if number < than else otherwise


OmegaConf.register_new_resolver("fewer", fewer, replace=True)


def settle_demonstrations(options: DictConfig) -> None:
    """Ask for no more demonstrations than were recorded elsewhere: presets do."""
    check_values(options)
    if options.recorded and (number := recorded(options.recorded)) < options.demonstrations.n:
        options.demonstrations.n = number


def open_run(options: DictConfig) -> Run:
    """Return the run of these options, with torch's threads and memory set.

    A new one takes over what its ``base`` has made, but for phase 2. Where fewer demonstrations
    were recorded elsewhere than asked for, the options ask for those.
    """
    settle_demonstrations(options)
    count_held_out(options.imitate.held_out, options.demonstrations.n)
    keep_freed_memory()
    torch.set_flush_denormal(True)  # late in training, tiny gradients would slow the CPU down
    if options.threads:
        torch.set_num_threads(options.threads)
    run = Run(options.run, options.logger)
    if options.base:
        for name in () if run.begun else (MADE, MACHINES):
            (run / name).unlink(missing_ok=True)  # of a call that was refused
        run.take_over(Run(options.base), without=PHASE_2)
    return run


def open_stage(
    options: DictConfig,
    name: str,
    sections: list[str],
    needs: list[str],
    without: Sequence[str] = (),
) -> Stage:
    """Return a stage that is decided by options or sections of them, the seed and the world.

    ``without`` names options of these sections, such as ``instruction.choose``, that do not count.

    Raises:
        UserError: where the stages that it needs are of another task or world, or one that was
            interrupted builds on what it would make anew.
    """
    release_freed_memory()  # of the stage before
    run = open_run(options)
    if needs:
        made = made_with(run)
        for place in filter(made.__contains__, PLACE):  # older runs do not name their world
            check_same(options, place, made[place], "say so")
    common = ["task", "seed", "network", "world"]
    decisive = {key: plain(OmegaConf.select(options, key)) for key in [*common, *sections]}
    for option in without:
        section, _, key = option.partition(".")
        decisive[section].pop(key)
    if changed := changed_networks(options):
        decisive["networks"] = changed  # only then: runs without any go on as they were
    stage = run.stage(name, decisive, needs)
    if stage.result is None:
        if (left := run.unfinished_on(name)) is not None:
            raise UserError(
                f"{name} would be made anew, for its options or an earlier stage are not what they "
                f"were, but {left} was interrupted, which builds on it as it is: give this run "
                f"another name, finish {left} with the options that it was begun with, or delete "
                f"{run / 'checkpoints' / left}*.pt to give it up"
            )
        keep_machine(stage, options.device)
        stage.begin()
        if name not in OF_LOOKS:
            of_stage = ["simulator", *common, "networks", *sections]
            stage.replacing = functools.partial(keep_options, run, options, of_stage)
    if stage.result is not None:
        doing = "done before"
    elif run.record(name):
        doing = "running, for its options or an earlier stage are not what they were"
    else:
        doing = "running"
    print(f"{name}: {doing}", flush=True)
    return stage


def keep_options(run: Run, options: DictConfig, names: Sequence[str]) -> None:
    """Keep with a run with which options it was made: ``names`` are those of its latest stage."""
    made = made_with(run) or plain(options)
    write_json(run / MADE, {**made, **{name: plain(options[name]) for name in names}})


def keep_machine(stage: Stage, device: str) -> None:
    """Keep with a run where a stage is done: here, and where it was begun."""
    noted = machines(stage.run)
    before = noted.get(stage.name, []) if stage.continues else []
    here = [*before, machine_of(device)]
    write_json(stage.run / MACHINES, {**noted, stage.name: list(dict.fromkeys(here))})


def machines(run: Run) -> dict[str, list[str]]:
    """Return on which machines the stages of a run were done; older runs do not say."""
    path = run / MACHINES
    return read_json(path) if path.exists() else {}


def made_with(run: Run) -> dict[str, Any]:
    """Return the options that a run was made with, empty where it does not say.

    Raises:
        UserError: where its file says something else.
    """
    path = run / MADE
    if not path.exists():
        return {}
    made = read_json(path)
    if not isinstance(made, dict) or not made.get("evaluate"):
        raise UserError(f"{path} is damaged: remove it, and say what the run was made with")
    return made


def check_same(options: DictConfig, name: str, there: Any, mend: str) -> None:
    """Raise :class:`UserError` where a run was made with another value of an option."""
    here = plain(OmegaConf.select(options, name))
    if here != there:
        raise UserError(
            f"the run {options.run} was made with {name}={there}, not {here}: {mend}, or name "
            "another run"
        )


@functools.cache
def recorded(folder: str) -> int:
    """Return how many demonstrations a folder holds that were recorded elsewhere.

    Raises:
        UserError: where there is no such folder, or it is damaged.
    """
    path = Path(str(folder))
    if not path.is_dir():
        raise UserError(f"recorded={folder} is no folder of demonstrations")
    return len(read_list(path) if (path / LIST).exists() else Demonstrations.load(path))


def changed_networks(options: DictConfig) -> dict[str, Any]:
    """Return which values of the networks the options replace."""
    return {name: value for name, value in options.networks.items() if value is not None}


def shows_progress(options: DictConfig) -> bool:
    """Whether to show progress bars: if asked to, and if somebody can see them move."""
    return options.progress and sys.stderr.isatty()


def need_phase_1(run: Run) -> None:
    """Make sure that a run has a phase-1 policy, of the labels that it has now.

    Raises:
        UserError: with what to run, where it has not.
    """
    run.need(POLICIES[0], "imitate")
    if not run.is_current("imitate"):
        raise UserError("phase 1 is of labels that were made anew: run the recipe imitate again")


def need_current(run: Run, stages: Sequence[str]) -> None:
    """Make sure that stages are done, and that nothing that they build on was made anew since.

    Raises:
        UserError: with what to run, where one is not.
    """
    for name in stages:
        if run.record(name) and not run.is_current(name):
            raise UserError(
                f"{name} builds on what was made anew since: run the recipe {name} again"
            )


def load_network(run: Run, name: str, recipe: str, options: DictConfig) -> Any:
    """Load a network that an earlier recipe trained."""
    return networks.load(run.need(name, recipe), device=options.device)


def result_file(
    folder: str, task: str, demonstrations: int, network: str, variant: str | None, seed: int
) -> Path:
    """Return the small file of what was measured of one run."""
    parts = [task, demonstrations, network, variant]
    name = "-".join(str(part) for part in parts if part)
    return Path(str(folder)) / f"{name}-seed{seed}.json"  # options read digits as a number


def starting_policy(run: Run, options: DictConfig, section: str) -> Any:
    """Return the phase-1 policy where a judge is to begin with its weights, else None."""
    begins = options[section].init_from_policy
    return load_network(run, POLICIES[0], "imitate", options) if begins else None


def load_demonstrations(run: Run) -> Demonstrations:
    """Load the recorded demonstrations."""
    return Demonstrations.load(run.need(DEMONSTRATIONS, "record_demonstrations"))


def practised_pool(run: Run, options: DictConfig) -> torch.Tensor:
    """Return the instructions that may be chosen: those of the demonstrations, or more."""
    return load_demonstrations(run).pool()


def load_labels(run: Run) -> LabelReport:
    """Load the inverse module's labels."""
    return LabelReport.load(run.need(LABELS, "label"))


def tell(result: dict[str, Any]) -> None:
    """Print what a stage found, one line each."""
    rows = [
        {"found": name.replace("_", " "), "value": _written(value)}
        for name, value in result.items()
    ]
    print(text_table(rows))


def _written(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_written, value))
    if not isinstance(value, float) or not math.isfinite(value):
        return format_cell(value)
    if not value.is_integer() and abs(value) < 1000:
        return f"{value:.4g}"
    return format_cell(round(value))


def plain(node: Any) -> Any:
    """Return options as dicts, lists and numbers."""
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
