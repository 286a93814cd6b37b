"""A run: one folder, made with one set of options, whose stages are done once and can go on."""

from __future__ import annotations

import contextlib
import copy
import fcntl
import functools
import os
import platform
import shutil
import time
import uuid
import warnings
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from ifo_grounding.errors import UserError, check_choice, first_line, optional
from ifo_grounding.files import (
    atomic_write,
    home,
    read_json,
    read_record,
    remove_leftovers,
    write_json,
    write_record,
)
from ifo_grounding.machine import processor
from ifo_grounding.training.checkpoint import difference, spent
from ifo_grounding.training.loop import Log, Metrics

EXTRAS = ("tensorboard", "wandb")
"""Loggers that are packages of their own, and extras of this one."""
LOGGERS = ("csv", *EXTRAS, "none")
OPTIONS = "config.yaml"
TAKEN = ".taken"
"""Folder for what is copied from another run, until all of it has its place."""
NOT_TAKEN = (OPTIONS, "logs", "checkpoints", "report", "result*.json", ".*")
"""What :meth:`Run.take_over` never copies."""
WRITTEN = ("stages", "metrics", "logs", "report", "report/pictures", "checkpoints/*")
"""Folders in a run's folder in which files are written."""
NUMBERS = (int, float)
_HELD: set[Path] = set()
"""Folders of the runs that this process has locked."""


class Run:
    """Folder of a run: ``config.yaml``, and what its stages make.

    Args:
        name: name of the run under the home folder (see :func:`ifo_grounding.files.home`), or a
            path to a folder, such as ``./name``.
        logger: ``csv``, ``tensorboard``, ``wandb`` or ``none``: where metrics go while training.

    Raises:
        UserError: on a logger that is unknown or not installed, or an empty name.

    >>> import tempfile
    >>> run = Run(tempfile.mkdtemp())
    >>> run.begin({"count": {"to": 3}})
    >>> run.stage("count").finish({"counted": 3}) == run.stage("count").result
    True
    """

    def __init__(self, name: str | Path, logger: str = "csv") -> None:
        check_choice("logger", logger, LOGGERS)
        if logger in EXTRAS:
            optional(logger, extra=logger)
        self.name = str(name)  # options read a name of digits as a number
        if not self.name:
            raise UserError("a run needs a name, or the path of its folder")
        given = Path(self.name).expanduser()
        is_path = len(given.parts) != 1 or self.name.startswith((".", "~", "/"))
        self.folder = given if is_path else home() / "runs" / given
        self.logger = logger

    def __truediv__(self, name: str) -> Path:
        return self.folder / name

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes out of the run while the block lasts, and remove unfinished files.

        The lock dies with this process, which may take it again. A file system without locks gets
        a warning.

        Raises:
            UserError: where another process holds the lock, with its number, machine and time.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        if (folder := self.folder.resolve()) in _HELD:
            yield
            return
        with (folder / ".lock").open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise UserError(
                    f"the run {self.name} is in use by {file.read().strip() or 'another process'}: "
                    "wait until it ends, or give another run="
                ) from None
            except OSError as error:
                warnings.warn(f"{folder} has no lock ({error}): work on it alone", stacklevel=3)
            else:
                remove_leftovers(folder, *(path for name in WRITTEN for path in folder.glob(name)))
            file.truncate(0)
            me = f"process {os.getpid()} on {platform.node()}"
            print(me, "since", time.strftime("%Y-%m-%d %H:%M:%S"), file=file, flush=True)
            _HELD.add(folder)
            try:
                yield
            finally:
                _HELD.remove(folder)

    def drop_if_empty(self) -> None:
        """Remove a run that a command began and made nothing of."""
        if {path.name for path in self.folder.glob("*")} <= {OPTIONS, ".lock"}:
            for name in (OPTIONS, ".lock"):
                (self / name).unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # a folder of others, or the current one
                self.folder.rmdir()

    def options(self) -> dict[str, Any] | None:
        """Return the options that the run was made with, None where it has not begun.

        Raises:
            UserError: where its ``config.yaml`` is damaged.
        """
        path = self / OPTIONS
        try:
            file = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (OSError, ValueError) as error:  # a name that is too long, or no name
            raise UserError(
                f"run={self.name!r:.40} names no folder ({first_line(error)})"
            ) from None
        try:
            options = _read_options(path.resolve(), file.st_ino, file.st_mtime_ns, file.st_size)
            if isinstance(options, dict):
                return {str(name): copy.deepcopy(value) for name, value in options.items()}
            why = "it holds no options"
        except Exception as error:  # of YAML, of OmegaConf, of the file
            why = first_line(error)
        raise UserError(f"{path} is damaged ({why}): restore it, or give another run=")

    def begin(self, options: dict[str, Any], free: Collection[str] = ()) -> None:
        """Write the options of a new run, or make sure that a run goes on with those it has.

        Args:
            options: nested dicts of numbers, strings, booleans, None and lists.
            free: dotted names, of options or of whole sections, that may differ from before.

        Raises:
            UserError: where the run was made with another value, or holds other files.
        """
        from omegaconf import OmegaConf

        made = self.options()
        if made is None:
            self._refuse_other_files()
            with atomic_write(self / OPTIONS) as temporary:
                OmegaConf.save(OmegaConf.create(options), temporary)
        elif found := difference(made, options, free):
            raise UserError(f"the run {self.name} was {found}, or give another run=")

    def _refuse_other_files(self) -> None:
        if any(self.folder.glob("[!.]*")) and not (self / "stages").is_dir():
            raise UserError(f"{self.folder} holds other files and no run: name another run")

    def stage(self, name: str) -> Stage:
        """Return a stage of the run."""
        return Stage(self, name)

    def record(self, name: str) -> dict[str, Any]:
        """Return what a stage left when it was done, empty where it was not."""
        path = self._record_path(name)
        return read_record(path) if path.exists() else {}

    def metrics(self, name: str) -> list[Metrics]:
        """Return the metrics of each iteration of a stage that is done, with their ``step``.

        Raises:
            UserError: where the file holds anything else.
        """
        path = self / f"metrics/{name}.json"
        rows = read_json(path, list) if path.exists() else []
        for row in rows:
            known = isinstance(row, dict) and type(row.get("step")) in NUMBERS
            if not known or not all(v is None or type(v) in NUMBERS for v in row.values()):
                raise UserError(f"{path} holds no metrics: delete it or restore it")
        return rows

    def records(self) -> dict[str, dict[str, Any]]:
        """Return what each stage that is done left."""
        names = sorted(path.stem for path in self.folder.glob("stages/*.json"))
        return {name: self.record(name) for name in names}

    def _record_path(self, name: str) -> Path:
        return self / f"stages/{name}.json"

    def need(self, name: str, recipe: str, stage: str | None = None) -> Path:
        """Return the path of what an earlier recipe made, in a stage of its own name by default.

        Raises:
            UserError: where it is not there, with the recipe that makes it.
        """
        path = self / name
        if not path.exists():
            # Its stage may count as done: to run it again has to help.
            self._record_path(stage or recipe).unlink(missing_ok=True)
            raise UserError(f"{path} is missing: run the recipe {recipe} with the same run first")
        return path

    def take_over(self, other: Run, without: Sequence[str] = ()) -> None:
        """Copy what another run has finished, but for its options, unless this one has begun.

        Args:
            without: patterns of names of stages and files that this run is to make anew.

        Raises:
            UserError: where the other run does not exist, or this folder holds what is no run's.
        """
        taken = self / TAKEN
        if (self / OPTIONS).exists():
            return
        if not taken.exists():
            if (self / "stages").is_dir():  # all is taken over, but the options are not written
                return
            self._refuse_other_files()
            if not (other / "stages").is_dir():
                raise UserError(f"{other.folder} holds no finished stages: run its recipes first")
            anew = [*NOT_TAKEN, *without, *(f"{name}.json" for name in without)]
            with atomic_write(taken) as temporary:
                shutil.copytree(other.folder, temporary, ignore=shutil.ignore_patterns(*anew))
        for entry in [*taken.iterdir()]:  # a killed process may have left some of them to move
            entry.replace(self / entry.name)
        taken.rmdir()


@functools.lru_cache(maxsize=8)
def _read_options(path: Path, *_state: int) -> Any:
    """Read a ``config.yaml``, which every stage asks for, once for each state of the file."""
    from omegaconf import OmegaConf

    return OmegaConf.to_container(OmegaConf.load(path), resolve=True)


class Stage:
    """One step of a run, such as training one network; done when its record is there.

    Attributes:
        result: what :meth:`finish` was given, or None where the stage is still to be done.
        checkpoint: file for its checkpoint.
    """

    def __init__(self, run: Run, name: str) -> None:
        self.run, self.name = run, name
        self.checkpoint = run / f"checkpoints/{name}/stage.pt"
        self.result: dict[str, Any] | None = run.record(name).get("result")
        if self.result is not None:
            self._drop_checkpoints()  # of a process that was killed just before it did
        self._start = time.monotonic() - sum(map(spent, self.checkpoint.parent.glob("*.pt")))

    def trial(self, number: int) -> Path:
        """Return the file for the checkpoint of one of several initial weights."""
        return self.checkpoint.with_stem(f"trial-{number}")

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
        record["threads"] = torch.get_num_threads()
        write_record(self.run._record_path(self.name), record)
        self._drop_checkpoints()
        self.result = result
        return result

    def log(self) -> Log | None:
        """Return a function that sends metrics to the run's TorchRL logger, None where it has none.

        A continued run repeats the steps since its checkpoint, which are not logged again.
        """
        if self.run.logger == "none":
            return None
        from torchrl.record.loggers import get_logger

        folder, options, name = self.run / "logs", {}, self.name
        if self.run.logger == "wandb":  # one run there for all stages of this folder
            if not (drawn := folder / "wandb-id.json").exists():
                write_json(drawn, uuid.uuid4().hex[:8])
            named = {"project": "ifo-grounding", "id": read_json(drawn, str)}
            options = {"wandb_kwargs": {**named, "reinit": True}}  # jobs of one process have theirs
            name = self.run.folder.resolve().name
        logger: Any = get_logger(self.run.logger, str(folder), name, **options)
        mark = folder / f"{self.name}-step.json"
        last = read_json(mark, int) if mark.exists() else -1

        def log(metrics: Metrics, step: int) -> None:
            if step <= last:
                return
            write_json(mark, step)  # first: a kill leaves a step out rather than log it twice
            for key, value in metrics.items():
                logger.log_scalar(f"{self.name}/{key}", value, step=step)
            if self.run.logger == "tensorboard":
                logger.experiment.flush()  # before the checkpoint that these steps are in

        return log

    def _drop_checkpoints(self) -> None:
        shutil.rmtree(self.checkpoint.parent, ignore_errors=True)
