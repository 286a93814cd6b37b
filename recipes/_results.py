"""Small files of what was measured; apart from `_shared`, for reports are slow to import."""

import shlex
import sys
from pathlib import Path

from _shared import machines, open_run, plain, result_file
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from ifo_grounding.errors import UserError
from ifo_grounding.files import read_json, write_json
from ifo_grounding.report import provenance


def write_result(options: DictConfig, results: dict, command: str) -> dict:
    """Write one small file that says what was measured, by which command, where and how long."""
    run = open_run(options)
    stages = {p.stem: run.record(p.stem)["seconds"] for p in (run / "stages").glob("*.json")}
    # Of one job of a sweep, what that job is.
    known = HydraConfig.initialized()
    given = HydraConfig.get().overrides.task if known else [t for t in sys.argv[1:] if "=" in t]
    content = {
        "command": f"ifo-grounding {command} {shlex.join(given)}".strip(),
        "options": plain(options),
        "seconds": round(sum(stages.values()), 1),
        "stages": stages,
        "machines": {stage: on for stage, on in machines(run).items() if stage in stages},
        "provenance": provenance(),
        "results": results,
    }
    write_json(run / "result.json", content)
    return content


def keep_result(options: DictConfig, content: dict) -> None:
    """Write what was measured into the folder of results, where one is named.

    Raises:
        UserError: where it holds such a file of another run.
    """
    if options.results:
        check_result(options)
        write_json(_file(options), content)


def check_result(options: DictConfig) -> None:
    """Raise :class:`UserError` where what will be measured would replace another run's file."""
    if not options.results or not (file := _file(options)).exists():
        return
    there = read_json(file).get("options", {}).get("run", options.run)
    if there != options.run:
        raise UserError(
            f"{file} is of the run {there}, not {options.run}: tell them apart with variant=, or "
            "name another folder of results"
        )


def _file(options: DictConfig) -> Path:
    of = (options.task, options.demonstrations.n, options.network, options.variant)
    return result_file(options.results, *of, options.seed)
