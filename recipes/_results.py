"""Small files of what was measured; apart from `_shared`, for reports are slow to import."""

import sys

from _shared import machines, open_run, plain, result_file
from omegaconf import DictConfig

from ifo_grounding.files import write_json
from ifo_grounding.report import provenance


def write_result(options: DictConfig, results: dict, command: str) -> dict:
    """Write one small file that says what was measured, by which command, where and how long."""
    run = open_run(options)
    stages = {p.stem: run.record(p.stem)["seconds"] for p in (run / "stages").glob("*.json")}
    given = [text for text in sys.argv[1:] if "=" in text]
    content = {
        "command": " ".join(["ifo-grounding", command, *given]),
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
    """Write what was measured into the folder of results, where one is named."""
    if options.results:
        of = (options.task, options.demonstrations.n, options.network, options.variant)
        write_json(result_file(options.results, *of, options.seed), content)
