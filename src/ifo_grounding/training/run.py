"""A run: one folder whose stages are done once, in order, and continue where they were killed."""

from __future__ import annotations

import csv
import importlib.util
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.files import atomic_write, home, read_json, write_json
from ifo_grounding.training.checkpoint import fingerprint, spent
from ifo_grounding.training.supervised import Log, Metrics

EXTRAS = ("tensorboard", "wandb")
"""Loggers that are packages of their own, and extras of this one."""
NEEDS = ".needs.json"
"""How the note of what an unfinished stage builds on is named, after the stage."""
LOGGERS = ("csv", *EXTRAS, "none")


class Run:
    """Folder of a run.

    Args:
        name: name of the run under the home folder (see :func:`ifo_grounding.files.home`), or a
            path to a folder anywhere, such as ``./name``.
        logger: ``csv``, ``tensorboard``, ``wandb`` or ``none``: where metrics go while training.

    Raises:
        UserError: on a logger that is unknown or not installed, or an empty name.

    >>> import tempfile
    >>> run = Run(tempfile.mkdtemp())
    >>> stage = run.stage("count", {"to": 3})
    >>> stage.result is None
    True
    >>> stage.finish({"counted": 3})["counted"]
    3
    >>> run.stage("count", {"to": 3}).result["counted"]
    3
    """

    def __init__(self, name: str | Path, logger: str = "csv") -> None:
        check_choice("logger", logger, LOGGERS)
        if logger in EXTRAS and importlib.util.find_spec(logger) is None:
            raise UserError(
                f"logger={logger} needs the extra of that name: "
                f"pip install 'ifo-grounding[{logger}]', or use logger=csv"
            )
        name = str(name)  # options read a name of digits as a number
        if not name:
            raise UserError("a run needs a name, or the path of its folder")
        given = Path(name).expanduser()
        is_path = len(given.parts) != 1 or name.startswith((".", "~", "/"))
        self.folder = given if is_path else home() / "runs" / given
        self.logger = logger

    def __truediv__(self, name: str) -> Path:
        """Return the path of something in the run's folder."""
        return self.folder / name

    def need(self, name: str, recipe: str) -> Path:
        """Return the path of what an earlier recipe made.

        Raises:
            UserError: where it is not there, with the recipe that makes it.
        """
        path = self.folder / name
        if not path.exists():
            # Its stage may count as done: to run it again has to help.
            self._record_path(recipe).unlink(missing_ok=True)
            raise UserError(f"{path} is missing: run the recipe {recipe} with the same run first")
        return path

    @property
    def begun(self) -> bool:
        """Whether any stage of it was done, or has left a checkpoint."""
        left = ("stages/*.json", "checkpoints/*.pt")
        return any(any(self.folder.glob(kind)) for kind in left)

    def take_over(self, other: Run, without: Sequence[str] = ()) -> None:
        """Copy what another run has made, unless this one has begun.

        Its finished stages count as done here, as long as their settings are the same. A phase 2
        can so be repeated with other options, from the same phase 1.

        Args:
            other: the run to copy.
            without: names of stages and files that this run is to make anew.

        Raises:
            UserError: where the other run does not exist, or this one's folder holds what is no
                run's.
        """
        if self.begun:
            return
        self._drop_notes()
        if self.folder.is_dir() and any(self.folder.iterdir()):
            raise UserError(f"{self.folder} holds other files and no run: name another run")
        if not (other.folder / "stages").is_dir():
            raise UserError(f"{other.folder} holds no finished stages: run its recipes first")
        anew = [*without, *(f"{name}.json" for name in without)]
        passing = shutil.ignore_patterns("logs", "checkpoints", "result.json", "report", *anew)
        copy = self.folder.with_name(f"{self.folder.name}.copying")
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(other.folder, copy, ignore=passing)
        copy.rename(self.folder)

    def _drop_notes(self) -> None:
        """Forget stages that were begun and left no checkpoint."""
        checkpoints = self.folder / "checkpoints"
        for note in checkpoints.glob(f"*{NEEDS}"):
            note.unlink()
        if checkpoints.is_dir() and not any(checkpoints.iterdir()):
            checkpoints.rmdir()

    def stage(self, name: str, settings: Any, needs: Sequence[str] = ()) -> Stage:
        """Return a stage, done only if its settings and all that it needs are as they were."""
        earlier = {need: self.record(need).get("settings") for need in needs}
        return Stage(self, name, fingerprint(settings, earlier), earlier)

    def is_current(self, name: str) -> bool:
        """Return whether a stage is done, and none that it read from was done anew since."""
        record = self.record(name)
        return bool(record) and all(
            self.record(need).get("settings") == settings
            and (settings is None or self.is_current(need))
            for need, settings in record.get("needs", {}).items()
        )

    def record(self, name: str) -> dict[str, Any]:
        """Return what a stage left when it was done, empty where it was not."""
        path = self._record_path(name)
        return read_json(path) if path.exists() else {}

    def unfinished_on(self, name: str) -> str | None:
        """Return an interrupted stage that builds on another as that is now, None without any."""
        for note in sorted((self.folder / "checkpoints").glob(f"*{NEEDS}")):
            begun = note.name.removesuffix(NEEDS)
            left = _checkpoints(note.with_name(f"{begun}.pt"))
            if left and self._builds_on(read_json(note), name):
                return begun
        return None

    def _builds_on(self, record: dict[str, Any], name: str) -> bool:
        """Whether a stage, of this record, was made from what another is now."""
        needs = record.get("needs", {})
        return any(
            settings == self.record(need).get("settings") is not None
            and (need == name or self._builds_on(self.record(need), name))
            for need, settings in needs.items()
        )

    def _record_path(self, name: str) -> Path:
        return self.folder / "stages" / f"{name}.json"


class Stage:
    """One step of a run, such as training one network.

    Attributes:
        settings: fingerprint of all that decides its result.
        result: what :meth:`finish` was given, or None where the stage is still to be done.
        continues: whether it was begun before, and left a checkpoint.
        checkpoint: file for its checkpoint.
        replacing: called by :meth:`replace`, where something is to be noted then.
    """

    def __init__(
        self, run: Run, name: str, settings: str, needs: Mapping[str, str | None] | None = None
    ) -> None:
        self.run, self.name, self.settings, self.needs = run, name, settings, dict(needs or {})
        record = run.record(name)
        self.result: dict[str, Any] | None = None
        if record.get("settings") == settings:
            self.result = record["result"]
        self.checkpoint = run.folder / "checkpoints" / f"{name}.pt"
        left = _checkpoints(self.checkpoint)
        self.continues = bool(left)
        self.replacing: Callable[[], None] | None = None
        self._start = time.monotonic() - (sum(map(spent, left)) if self.result is None else 0.0)

    @property
    def _note(self) -> Path:
        return self.checkpoint.with_suffix(NEEDS)

    def begin(self) -> None:
        """Note beside its checkpoint what the stage builds on, for as long as it is not done."""
        write_json(self._note, {"needs": self.needs})

    def replace(self) -> None:
        """Forget that the stage is done: what was made with other settings is written over now."""
        self.run._record_path(self.name).unlink(missing_ok=True)
        if self.replacing is not None:
            self.replacing()

    def finish(
        self, result: dict[str, Any], history: Sequence[Metrics] | None = None
    ) -> dict[str, Any]:
        """Record that the stage is done, drop its checkpoints, and return ``result``."""
        seconds = round(time.monotonic() - self._start, 1)
        if history is not None:
            write_json(self.run.folder / "metrics" / f"{self.name}.json", list(history))
        made_of = {"settings": self.settings, "needs": self.needs}
        record = {**made_of, "result": result, "seconds": seconds}
        write_json(self.run._record_path(self.name), record)
        for path in (*_checkpoints(self.checkpoint), self._note):
            path.unlink(missing_ok=True)
        self.result = result
        return result

    def log(self) -> Log | None:
        """Return a function that sends metrics to the run's TorchRL logger.

        A continued run repeats the steps since its checkpoint exactly. In ``csv`` files those that
        are logged already are not logged again; other loggers get them twice.
        """
        if self.run.logger == "none":
            return None
        from torchrl.record.loggers import get_logger

        folder = self.run.folder / "logs"
        goes_on = self.continues
        if self.run.logger != "wandb":
            made_of = folder / self.name / "settings"
            goes_on &= made_of.exists() and made_of.read_text() == self.settings
            if not goes_on:
                shutil.rmtree(folder / self.name, ignore_errors=True)  # of other settings
            with atomic_write(made_of) as temporary:
                temporary.write_text(self.settings)
        logged = _last_step(folder / self.name) if goes_on else -1
        options = (
            {"wandb_kwargs": {"project": "ifo-grounding"}} if self.run.logger == "wandb" else {}
        )
        logger: Any = get_logger(self.run.logger, str(folder), self.name, **options)

        def log(metrics: Metrics, step: int) -> None:
            if step > logged:
                for key, value in metrics.items():
                    logger.log_scalar(f"{self.name}/{key}", value, step=step)

        return log


def _checkpoints(path: Path) -> list[Path]:
    """Return a checkpoint, if it is there, and those named after it with a dash and a number."""
    beside = (
        other
        for other in path.parent.glob(f"{path.stem}-*.pt")
        if other.stem[len(path.stem) + 1 :].isdigit()
    )
    return [*([path] if path.exists() else []), *sorted(beside)]


def _last_step(folder: Path) -> int:
    last = -1
    for path in folder.rglob("*.csv"):
        with path.open(newline="") as file:
            last = max([last, *(int(float(row[0])) for row in csv.reader(file) if row)])
    return last
