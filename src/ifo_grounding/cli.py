"""The command ``ifo-grounding``: runs a recipe with options from the command line."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Sequence
from importlib.metadata import version

from ifo_grounding import _folder
from ifo_grounding._folder import recipe_names
from ifo_grounding._recipes import one_line_errors, recipe_main
from ifo_grounding.errors import UserError, did_you_mean

__all__ = ["COMMANDS", "main", "recipe_main"]

COMMANDS = {
    "demo": ("two_phase", "train and compare both phases on one task, then write a report"),
    "evaluate": ("evaluate", "success rate of a trained policy, with its interval"),
    "record": ("record_demonstrations", "record observation-only demonstrations of a task"),
    "report": ("report", "tables, curves and animations of finished runs"),
}
"""Commands, the recipe behind each, and what it does."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``ifo-grounding`` with ``arguments`` (default: those of the process).

    A mistake prints one line on stderr and exits with code 2.
    """
    command, *rest = (list(sys.argv[1:] if arguments is None else arguments)) or ["--help"]
    with one_line_errors():
        asked = rest if command == "run" else [command]
        if asked[:1] and asked[0] in ("-h", "--help", "help"):
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
    options = list(rest)
    if command in COMMANDS:
        return COMMANDS[command][0], options
    if command != "run":
        raise UserError(_unknown("command", command, [*COMMANDS, "run"]))
    names = recipe_names()
    if not options:
        raise UserError(f"which recipe? choose one of {', '.join(names)}")
    recipe = options.pop(0).removesuffix(".py")
    if recipe not in names:
        raise UserError(_unknown("recipe", recipe, names))
    return recipe, options


def run_recipe(name: str, options: Sequence[str]) -> None:
    """Run a recipe's script in this process, as ``python recipes/<name>.py <options>`` does."""
    script = str(_folder.recipes_folder() / f"{name}.py")
    argv, path = sys.argv, list(sys.path)
    sys.argv = [script, *options]
    sys.path.insert(0, str(_folder.recipes_folder()))
    try:
        runpy.run_path(script, run_name="__main__")
    finally:
        sys.argv, sys.path[:] = argv, path


def _unknown(what: str, given: str, allowed: Sequence[str]) -> str:
    hint = did_you_mean(given, allowed)
    return f"unknown {what} {given!r}{hint}: choose one of {', '.join(allowed)}"
