"""A run: one folder, made with one set of options, whose stages are done once and can go on."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import importlib.util
import os
import platform
import shutil
import time
import uuid
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.files import atomic_write, home, read_json, write_json
from ifo_grounding.machine import processor
from ifo_grounding.training.checkpoint import difference, spent
from ifo_grounding.training.loop import Log, Metrics

EXTRAS = ("tensorboard", "wandb")
"""Loggers that are packages of their own, and extras of this one."""
LOGGERS = ("csv", *EXTRAS, "none")
OPTIONS = "config.yaml"
TAKEN = ".taken"
"""Folder for what is copied from another run, until all of it has its place."""
NOT_TAKEN = (OPTIONS, "logs", "checkpoints", "report", "result.json", ".*")
"""What :meth:`Run.take_over` never copies."""


class Run:
    """Folder of a run: ``config.yaml``, and what its stages make.

    Args:
        name: name of the run under the home folder (see :func:`ifo_grounding.files.home`), or a
            path to a folder anywhere, such as ``./name``.
        logger: ``csv``, ``tensorboard``, ``wandb`` or ``none``: where metrics go while training.

    Raises:
        UserError: on a logger that is unknown or not installed, or an empty name.

    >>> import tempfile
    >>> run = Run(tempfile.mkdtemp())
    >>> options = run.begin({"count": {"to": 3}})
    >>> run.stage("count").finish({"counted": 3})
    {'counted': 3}
    >>> run.stage("count").result
    {'counted': 3}
    """

    def __init__(self, name: str | Path, logger: str = "csv") -> None:
        check_choice("logger", logger, LOGGERS)
        if logger in EXTRAS and importlib.util.find_spec(logger) is None:
            raise UserError(
                f"logger={logger} needs the extra of that name: "
                f"pip install 'ifo-grounding[{logger}]', or use logger=csv"
            )
        self.name = str(name)  # options read a name of digits as a number
        if not self.name:
            raise UserError("a run needs a name, or the path of its folder")
        given = Path(self.name).expanduser()
        is_path = len(given.parts) != 1 or self.name.startswith((".", "~", "/"))
        self.folder = given if is_path else home() / "runs" / given
        self.logger = logger

    def __truediv__(self, name: str) -> Path:
        """Return the path of something in the run's folder."""
        return self.folder / name

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes out of the run while the block lasts; the lock dies with this one.

        The process that holds the lock may take it again. Files that a killed process was writing
        are removed.

        Raises:
            UserError: where another process holds the lock, with its number, machine and time.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        me = f"process {os.getpid()} on {platform.node()}"
        with (self / ".lock").open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                file.truncate(0)
                print(me, "since", time.strftime("%Y-%m-%d %H:%M:%S"), file=file, flush=True)
                for stale in [*self.folder.rglob(".*.tmp")]:
                    shutil.rmtree(stale) if stale.is_dir() else stale.unlink(missing_ok=True)
            except BlockingIOError:
                file.seek(0)
                holder = file.read().strip()
                if not holder.startswith(f"{me} "):
                    raise UserError(
                        f"the run {self.name} is in use by {holder or 'another process'}: wait "
                        "until it ends, or give another run="
                    ) from None
            yield

    def options(self) -> dict[str, Any] | None:
        """Return the options that the run was made with, None where it has not begun.

        Raises:
            UserError: where its ``config.yaml`` is damaged.
        """
        path = self / OPTIONS
        if not path.exists():
            return None
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException
        from yaml import YAMLError

        try:
            options = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
            if isinstance(options, dict):
                return {str(name): value for name, value in options.items()}
            why = "it holds no options"
        except (OmegaConfBaseException, YAMLError, ValueError, OSError) as error:
            why = str(error).splitlines()[0]
        raise UserError(f"{path} is damaged ({why}): restore it, or give another run=")

    def begin(self, options: dict[str, Any], free: Collection[str] = ()) -> dict[str, Any]:
        """Write the options of a new run, or make sure that a run goes on with those it has.

        Args:
            options: nested dicts of numbers, strings, booleans, None and lists.
            free: dotted names, of options or of whole sections, that may differ from before.

        Returns:
            ``options``.

        Raises:
            UserError: where the run was made with another value, or its file is damaged.
        """
        from omegaconf import OmegaConf

        made = self.options()
        if made is None:
            with atomic_write(self / OPTIONS) as temporary:
                OmegaConf.save(OmegaConf.create(options), temporary)
        elif found := difference(made, options, free):
            raise UserError(f"the run {self.name} was {found}, or give another run=")
        return options

    def stage(self, name: str) -> Stage:
        """Return a stage of the run."""
        return Stage(self, name)

    def record(self, name: str) -> dict[str, Any]:
        """Return what a stage left when it was done, empty where it was not."""
        path = self._record_path(name)
        return read_json(path) if path.exists() else {}

    def _record_path(self, name: str) -> Path:
        return self / f"stages/{name}.json"

    def need(self, name: str, recipe: str) -> Path:
        """Return the path of what an earlier recipe made.

        Raises:
            UserError: where it is not there, with the recipe that makes it.
        """
        path = self / name
        if not path.exists():
            # Its stage may count as done: to run it again has to help.
            self._record_path(recipe).unlink(missing_ok=True)
            raise UserError(f"{path} is missing: run the recipe {recipe} with the same run first")
        return path

    @property
    def begun(self) -> bool:
        """Whether it has options, or any stage was done or has left a checkpoint."""
        left = (OPTIONS, "stages/*.json", "checkpoints/*.pt")
        return any(any(self.folder.glob(kind)) for kind in left)

    def take_over(self, other: Run, without: Sequence[str] = ()) -> None:
        """Copy what another run has made, but for its options, unless this one has begun.

        What the other run has finished counts as done here. A phase 2 can so be repeated with
        other options, from the same phase 1.

        Args:
            other: the run to copy.
            without: names of stages and files that this run is to make anew.

        Raises:
            UserError: where the other run does not exist, or this one's folder holds what is no
                run's.
        """
        taken = self / TAKEN
        if (self / OPTIONS).exists():
            return
        if not taken.exists():
            if self.begun:  # it has taken over all, and was killed before its options were written
                return
            if any(self.folder.glob("[!.]*")):
                raise UserError(f"{self.folder} holds other files and no run: name another run")
            if not (other / "stages").is_dir():
                raise UserError(f"{other.folder} holds no finished stages: run its recipes first")
            anew = [*NOT_TAKEN, *without, *(f"{name}.json" for name in without)]
            with atomic_write(taken) as temporary:
                shutil.copytree(other.folder, temporary, ignore=shutil.ignore_patterns(*anew))
        for entry in [*taken.iterdir()]:  # a killed process may have left some of them to move
            entry.replace(self / entry.name)
        taken.rmdir()


class Stage:
    """One step of a run, such as training one network; done when its record is there.

    Attributes:
        result: what :meth:`finish` was given, or None where the stage is still to be done.
        checkpoint: file for its checkpoint.
    """

    def __init__(self, run: Run, name: str) -> None:
        self.run, self.name = run, name
        self.checkpoint = run / f"checkpoints/{name}.pt"
        self.result: dict[str, Any] | None = run.record(name).get("result")
        if self.result is not None:
            self._drop_checkpoints()  # of a process that was killed just before it did
        self._start = time.monotonic() - sum(map(spent, self._checkpoints()))

    def trial(self, number: int) -> Path:
        """Return the file for the checkpoint of one of several initial weights."""
        return self.checkpoint.with_stem(f"{self.name}-{number}")

    def finish(
        self,
        result: dict[str, Any],
        history: Sequence[Metrics] | None = None,
        machine: str | None = None,
    ) -> dict[str, Any]:
        """Record that the stage is done, drop its checkpoints, and return ``result``.

        Args:
            result: what was found, values that JSON can hold.
            history: metrics of each iteration, for ``metrics/NAME.json``.
            machine: what computed (see :func:`ifo_grounding.machine.machine_of`); by default this
                machine's processor.
        """
        seconds = round(time.monotonic() - self._start, 1)
        if history is not None:
            write_json(self.run / f"metrics/{self.name}.json", list(history))
        record = {"result": result, "seconds": seconds, "machine": machine or processor()}
        write_json(self.run._record_path(self.name), record)
        self._drop_checkpoints()
        self.result = result
        return result

    def log(self) -> Log | None:
        """Return a function that sends metrics to the run's TorchRL logger.

        A continued run repeats the steps since its checkpoint exactly. In ``csv`` and
        ``tensorboard`` files those that are logged already are not logged again; ``wandb`` gets
        them twice, in the one run there that belongs to this folder.
        """
        if self.run.logger == "none":
            return None
        from torchrl.record.loggers import get_logger

        folder, options, name = self.run / "logs", {}, self.name
        if self.run.logger == "wandb":
            options = {"wandb_kwargs": {"project": "ifo-grounding", "id": _wandb_id(folder)}}
            name = self.run.folder.resolve().name
        logged = _last_steps(folder / self.name, self.run.logger)
        logger: Any = get_logger(self.run.logger, str(folder), name, **options)

        def log(metrics: Metrics, step: int) -> None:
            for key, value in metrics.items():
                if step > logged.get(full := f"{self.name}/{key}", -1):
                    logger.log_scalar(full, value, step=step)
            if self.run.logger == "tensorboard":
                logger.experiment.flush()  # before the checkpoint that these steps are in

        return log

    def _checkpoints(self) -> list[Path]:
        """Return its checkpoint and those of its trials, as far as they are there."""
        trials = self.checkpoint.parent.glob(f"{self.name}-*.pt")
        numbered = [path for path in trials if path.stem[len(self.name) + 1 :].isdigit()]
        return [path for path in (self.checkpoint, *sorted(numbered)) if path.exists()]

    def _drop_checkpoints(self) -> None:
        for path in self._checkpoints():
            path.unlink(missing_ok=True)


def _wandb_id(folder: Path) -> str:
    """Return by which id Weights and Biases goes on with a run, drawn once per folder."""
    path = folder / "wandb-id"
    if not path.exists():
        with atomic_write(path) as temporary:
            temporary.write_text(uuid.uuid4().hex[:8])
    return path.read_text()


def _last_steps(folder: Path, logger: str) -> Mapping[str, int]:
    """Return the last step that a stage has logged of each metric, from the files in ``folder``."""
    last: dict[str, int] = {}
    if logger == "csv":
        scalars = folder / "scalars"
        for path in scalars.rglob("*.csv"):
            with path.open(newline="") as file:
                steps = [int(float(row[0])) for row in csv.reader(file) if row]
            last[str(path.relative_to(scalars).with_suffix(""))] = max(steps, default=-1)
    elif logger == "tensorboard" and folder.is_dir():
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        events = EventAccumulator(str(folder), size_guidance={"scalars": 1}).Reload()
        for key in events.Tags()["scalars"]:
            last[key] = events.Scalars(key)[-1].step
    return last
