"""What every recipe needs: the run, its stages, what they left, and how to tell of it."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl import torchrl_logger

from ifo_grounding import networks
from ifo_grounding.allocation import keep_freed_memory, release_freed_memory
from ifo_grounding.data import Demonstrations, LabelReport, recombined
from ifo_grounding.data.pictures import LIST, read_list
from ifo_grounding.errors import UserError
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
RUNNING = ("checkpoint_seconds", "logger", "progress", "threads", "device")
"""Options that decide no result."""
AT_LEAST_ONE = (
    "threads",
    "demonstrations.n",
    "transitions.n",
    "transitions.num_envs",
    "self_examine.num_envs",
    "evaluate.episodes",
    "evaluate.audit_episodes",
    "imitate.trials",
    "imitate.trial_steps",
    "instruction.trials",
    "instruction.trial_steps",
)


def fewer(number: int, than: int, value: Any, otherwise: Any) -> Any:
    """Return a value where a number is below another; in options ``${fewer:number,than,...}``.

    >>> fewer(200, 1000, 64, 256)
    64
    """
    return value if number < than else otherwise


OmegaConf.register_new_resolver("fewer", fewer, replace=True)


def open_run(options: DictConfig) -> Run:
    """Return the run of these options, with torch's threads and memory set.

    Where fewer demonstrations were recorded elsewhere than asked for, the options ask for those.
    """
    for name in AT_LEAST_ONE:
        if (number := OmegaConf.select(options, name)) is not None and number < 1:
            raise UserError(f"{name} must be at least 1, got {number}")
    if (halvings := options.imitate.get("trial_halvings", 0)) < 0:
        raise UserError(f"imitate.trial_halvings must not be negative, got {halvings}")
    if (share := options.imitate.held_out) >= 1 or share < 0:
        raise UserError(
            f"imitate.held_out is a share of the demonstrations, in [0, 1), got {share}"
        )
    try:
        device = torch.device(options.device)
    except RuntimeError:
        raise UserError(f"device={options.device} is none: use cpu, cuda or cuda:0") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise UserError(f"device={options.device}: torch sees no GPU here; use device=cpu")
    if options.recorded and (number := recorded(options.recorded)) < options.demonstrations.n:
        options.demonstrations.n = number  # presets ask for it
    keep_freed_memory()
    torch.set_flush_denormal(True)  # late in training, tiny gradients would slow the CPU down
    if options.threads:
        torch.set_num_threads(options.threads)
    return Run(options.run, options.logger)


def open_stage(options: DictConfig, name: str, sections: list[str], needs: list[str]) -> Stage:
    """Return a stage that is decided by options or sections of them, the seed and the world."""
    release_freed_memory()  # of the stage before
    run = open_run(options)
    common = ["task", "seed", "network", "world"]
    decisive = {key: plain(OmegaConf.select(options, key)) for key in [*common, *sections]}
    if changed := changed_networks(options):
        decisive["networks"] = changed  # only then: runs without any go on as they were
    stage = run.stage(name, decisive, needs)
    if stage.result is not None:
        doing = "done before"
    elif run.record(name):
        doing = "running, for its options or an earlier stage are not what they were"
    else:
        doing = "running"
    print(f"{name}: {doing}", flush=True)
    return stage


@functools.cache
def recorded(folder: str) -> int:
    """Return how many demonstrations a folder holds that were recorded elsewhere.

    Raises:
        UserError: where there is no such folder, or it is damaged.
    """
    path = Path(folder)
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
    return Path(folder) / f"{name}-seed{seed}.json"


def starting_policy(run: Run, options: DictConfig, section: str) -> Any:
    """Return the phase-1 policy where a judge is to begin with its weights, else None."""
    begins = options[section].init_from_policy
    return load_network(run, POLICIES[0], "imitate", options) if begins else None


def load_demonstrations(run: Run) -> Demonstrations:
    """Load the recorded demonstrations."""
    return Demonstrations.load(run.need(DEMONSTRATIONS, "record_demonstrations"))


def practised_pool(run: Run, options: DictConfig) -> torch.Tensor:
    """Return the instructions that may be chosen: those of the demonstrations, or more."""
    pool = load_demonstrations(run).pool()
    return torch.cat([pool, recombined(pool)]) if options.self_examine.recombine else pool


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
    if isinstance(value, float) and not value.is_integer() and abs(value) < 1000:
        return f"{value:.4g}"
    return format_cell(round(value) if isinstance(value, float) else value)


def plain(node: Any) -> Any:
    """Return options as dicts, lists and numbers."""
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
