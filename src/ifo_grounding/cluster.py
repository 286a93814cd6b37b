"""A Ray cluster: recipes run on all its machines, and go on after one of them has died."""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ifo_grounding.errors import UserError, optional
from ifo_grounding.files import home

RETRIES = 10
"""How often a task runs again whose process or machine died."""
LOCKED = 60
"""Seconds in which processes that end, or whose machine died, give up their runs."""


@dataclass(frozen=True)
class Call:
    """A recipe, its options, and the file that its output goes to."""

    recipe: str
    options: tuple[str, ...]
    run: str
    log: Path
    gpus: int = 0


def connect() -> Any:
    """Return Ray, connected to the cluster of ``RAY_ADDRESS`` or of this machine.

    Where there is none, this machine alone becomes one.

    Raises:
        UserError: where Ray is not installed, or the cluster cannot be reached.
    """
    ray = optional("ray", extra="ray")
    if not ray.is_initialized():
        try:
            ray.init(include_dashboard=False, log_to_driver=False, logging_level="ERROR")
        except Exception as error:  # of Ray, whatever it raises
            where = os.environ.get("RAY_ADDRESS", "this machine")
            raise UserError(f"no Ray cluster at {where} ({error}): see `ray status`") from None
    return ray


def environment() -> dict[str, dict[str, str]]:
    """Return what processes of the cluster are told: where modules and runs are."""
    modules = os.pathsep.join(filter(None, sys.path))
    return {"env_vars": {"PYTHONPATH": modules, "IFO_GROUNDING_HOME": str(home().resolve())}}


def run_on_cluster(chains: Sequence[Sequence[Call]], progress: bool = True) -> list[Call]:
    """Run recipes as Ray tasks of one processor each; return those that ended with an error.

    Those of a chain run one after the other; after an error the rest of the chain is left out. A
    task whose process or machine dies runs again elsewhere, and goes on from its checkpoint. The
    home folder and the current one have to be shared by all machines.
    """
    ray = connect()
    # A process takes one task alone, since it holds the locks of its runs as long as it lives.
    task = ray.remote(num_cpus=1, max_calls=1, max_retries=RETRIES, runtime_env=environment())(_run)
    waiting, failed = {}, set()
    for chain in chains:
        before = None
        for call in chain:
            before = task.options(num_gpus=call.gpus).remote(call, str(Path.cwd()), before)
            waiting[before] = call
    with tqdm(total=len(waiting), unit="run", disable=not progress) as bar:
        while waiting:
            for reference in ray.wait(list(waiting))[0]:
                call = waiting.pop(reference)
                try:
                    ray.get(reference)
                except ray.exceptions.RayError:  # its own, or that of a call before
                    failed.add(call)
                else:
                    _wait_for(call.run)
                    bar.update()
    return [call for chain in chains for call in [each for each in chain if each in failed][:1]]


def spread(function: Callable[[Any], Any], values: Iterable[Any]) -> Iterator[Any]:
    """Yield what a function returns for each value, in order, as Ray tasks of one processor each.

    Not many more are called than are waited for. A task whose process or machine dies runs again.
    """
    ray = connect()
    task = ray.remote(num_cpus=1, max_retries=RETRIES, runtime_env=environment())(_apply)
    ahead, waiting = 2 * int(ray.cluster_resources().get("CPU", 1)), deque[Any]()
    for value in values:
        waiting.append(task.remote(function, value))
        if len(waiting) > ahead:
            yield ray.get(waiting.popleft())
    yield from map(ray.get, waiting)


def _apply(function: Callable[[Any], Any], value: Any) -> Any:
    return function(value)


def _wait_for(run: str) -> None:
    """Wait until no other process works on a run: its task may be done before its process ends."""
    from ifo_grounding.training import Run

    for _ in range(LOCKED):
        with suppress(UserError), Run(run).lock():
            break
        time.sleep(1)


def _run(call: Call, folder: str, _before: None) -> None:
    """Run a recipe in this process, which is one of Ray's."""
    from ifo_grounding.cli import run_recipe

    os.chdir(folder)
    _wait_for(call.run)
    call.log.parent.mkdir(parents=True, exist_ok=True)
    with call.log.open("w") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            run_recipe(call.recipe, call.options)
        except SystemExit as ended:
            if ended.code:
                raise RuntimeError(f"see {call.log}") from None
        except BaseException:
            traceback.print_exc()
            raise
