"""The command ``ifo-grounding``: runs a recipe with options from the command line."""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import re
import runpy
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ifo_grounding.errors import UserError, check_choice
from ifo_grounding.texts import one_line

USAGE_ERROR, INTERRUPTED, CLOSED = 2, 130, 141
HELP = ("-h", "--help")
COMMANDS = {
    "demo": ("two_phase", "train and compare both phases on one task, then write a report"),
    "evaluate": ("evaluate", "success rate of a trained policy, with its interval"),
    "play": ("play", "tell a trained policy a sentence in a scene, and see what it does"),
    "record": ("record_demonstrations", "record observation-only demonstrations of a task"),
    "report": ("report", "tables, curves and animations of finished runs"),
}
"""Commands, the recipe behind each, and what it does."""


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Turn a :class:`UserError` into ``error: ...`` on stderr and exit code 2, without a traceback.

    So it does with what the system refuses, such as a full disk. SIGTERM interrupts as SIGINT does.
    ``IFO_GROUNDING_TRACEBACK=1`` in the environment keeps the traceback.
    """
    with contextlib.suppress(ValueError):  # another thread than the main one
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except BrokenPipeError:  # whoever reads what is printed, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(CLOSED) from None
    except (UserError, OSError) as error:
        if os.environ.get("IFO_GROUNDING_TRACEBACK") == "1":
            raise
        print("error:", one_line(error), file=sys.stderr)
        raise SystemExit(USAGE_ERROR) from None
    except (KeyboardInterrupt, RuntimeError) as error:
        # Within tensordict's `with params.to_module(...)` an interruption becomes a RuntimeError.
        if KeyboardInterrupt not in (type(error), type(error.__context__)):
            raise
        print("interrupted", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None


def recipe_main(function: Callable[[Any], object]) -> Callable[[], None]:
    """Decorate the function of a recipe script, which takes the options.

    The options are composed from ``conf/config.yaml`` and ``name=value`` on the command line, and
    checked; a recipe with a ``conf/<script name>.yaml`` has options of its own. Mistakes are shown
    as of :func:`one_line_errors`. Results of several jobs become one table of means over seeds.
    """
    script = Path(inspect.getfile(function)).resolve()

    @functools.wraps(function)
    def main() -> None:
        with one_line_errors():
            from ifo_grounding.options import help_text, options_of_jobs

            words = [word for word in sys.argv[1:] if word not in HELP]
            help_asked = len(words) < len(sys.argv) - 1
            found, jobs = [], options_of_jobs(script, words, new=help_asked)
            if not help_asked:
                _run_on_cluster(script, words, jobs)  # what is done is only told below
            for options in jobs:
                if help_asked:
                    print(help_text(script, options))
                elif isinstance(results := function(options), dict):
                    seed = rf"(.*)(?<!\d){options.seed}(?!\d)"  # where it stands last
                    found.append((re.sub(seed, r"\1*", options.run), results))
            if found[1:]:
                from ifo_grounding.report.results import seeds_table

                print("", seeds_table(found), sep="\n")

    return main


def _run_on_cluster(script: Path, words: Sequence[str], jobs: Sequence[Any]) -> None:
    """Run those jobs of a recipe on a Ray cluster that are to run there (``ray=true``)."""
    from ifo_grounding.cluster import Call, run_on_cluster
    from ifo_grounding.config import Options
    from ifo_grounding.options import words_of_jobs
    from ifo_grounding.training import Run

    chains = []
    for given, job in zip(words_of_jobs(words), jobs, strict=True):
        if isinstance(job, Options) and job.ray:
            given = [*(word for word in given if not word.startswith("ray=")), "ray=false"]
            log = Path(f"{Run(job.run).folder.resolve()}.log")
            chains.append([Call(script.stem, (*given,), job.run, log, int(job.device != "cpu"))])
    if chains and (failed := run_on_cluster(chains, jobs[0].progress)):
        raise UserError(f"ended with an error: {', '.join(str(call.log) for call in failed)}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``ifo-grounding`` with ``arguments`` (default: those of the process)."""
    command, *rest = (list(sys.argv[1:] if arguments is None else arguments)) or ["--help"]
    with one_line_errors():
        asked = rest if command == "run" else [command]
        if asked[:1] and asked[0] in (*HELP, "help"):
            print(usage())
        elif command == "--version":
            print("ifo-grounding", version("ifo-grounding"))
        else:
            recipe, options = resolve(command, rest)
            run_recipe(recipe, options)


def usage() -> str:
    """Text of ``ifo-grounding --help``."""
    width = max(map(len, COMMANDS))
    lines = ["usage: ifo-grounding <command> [name=value ...]", "", "commands:"]
    lines += [f"  {name:<{width}}  {text}" for name, (_, text) in COMMANDS.items()]
    lines += [f"  {'run':<{width}}  any recipe by its name: ifo-grounding run <recipe>", ""]
    lines += ["recipes: " + ", ".join(recipe_names()), ""]
    lines += ["ifo-grounding <command> --help and ifo-grounding run <recipe> --help list options."]
    return "\n".join(lines)


def resolve(command: str, rest: Sequence[str]) -> tuple[str, list[str]]:
    """Return the recipe that a command stands for, and its options.

    >>> resolve("demo", ["task=pick"])
    ('two_phase', ['task=pick'])
    """
    check_choice("command", command, [*COMMANDS, "run"])
    options = list(rest)
    if command in COMMANDS:
        return COMMANDS[command][0], options
    names = recipe_names()
    if not options:
        raise UserError(f"which recipe? choose one of {', '.join(names)}")
    recipe = options.pop(0).removesuffix(".py")
    check_choice("recipe", recipe, names)
    return recipe, options


def run_recipe(name: str, options: Sequence[str]) -> None:
    """Run a recipe's script in this process, as ``python recipes/<name>.py <options>`` does."""
    folder = recipes_folder()
    argv, path = sys.argv, list(sys.path)
    sys.argv = [str(folder / f"{name}.py"), *options]
    sys.path.insert(0, str(folder))
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    finally:
        sys.argv, sys.path[:] = argv, path


def recipes_folder() -> Path:
    """Return the folder of the recipes: inside an installed wheel, or beside ``src``.

    >>> (recipes_folder() / "conf" / "config.yaml").is_file()
    True
    """
    package = Path(__file__).resolve().parent
    for folder in (package / "recipes", package.parents[1] / "recipes"):
        if (folder / "conf").is_dir():
            return folder
    raise UserError("this installation has no recipes: install ifo-grounding again")


def recipe_names() -> list[str]:
    """Return the names of all recipes, sorted."""
    return sorted(path.stem for path in recipes_folder().glob("[!_]*.py"))
