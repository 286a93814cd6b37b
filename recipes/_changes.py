"""Which options of runs that were made before would be others today, by presets and budgets."""

import contextlib
import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from _shared import RUNNING, plain
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig


def changes(
    then: Mapping[str, Any], arguments: Sequence[str], sections: Sequence[str] | None = None
) -> list[str]:
    """Return which options of a run of the recipe `study` would be others today.

    Args:
        then: its options.
        arguments: of the recipe.
        sections: of the options to look at; all where None.
    """
    both = (
        {k: v for k, v in each.items() if sections is None or k in sections}
        for each in (then, today(tuple(arguments)))
    )
    return list(differences(*map(in_effect, both)))


@functools.cache
def today(arguments: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of the recipe `study` with these arguments."""
    conf = str(Path(__file__).with_name("conf"))
    begun = GlobalHydra.instance().is_initialized()  # as by the recipe itself
    with (
        contextlib.nullcontext()
        if begun
        else initialize_config_dir(version_base=None, config_dir=conf)
    ):
        return plain(compose("study", overrides=["run=unnamed", *arguments]))


def flat(section: DictConfig | dict[str, Any], above: str = "") -> dict[str, Any]:
    """Return the options of a section and of those below it, by their full names."""
    found: dict[str, Any] = {}
    for name, value in plain(section).items():
        full = above + name
        found |= flat(value, f"{full}.") if isinstance(value, dict) else {full: value}
    return found


def effective(section: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a section that have an effect: one trial is none."""
    alone = ("trials", "trial_steps", "trial_halvings") if section.get("trials", 1) == 1 else ()
    return {name: value for name, value in section.items() if name not in alone}


def in_effect(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a run that have an effect, by their full names."""
    return flat(
        {
            part: effective(section) if isinstance(section, dict) else section
            for part, section in options.items()
        }
    )


def differences(then: dict[str, Any], today: dict[str, Any]) -> Iterator[str]:
    """Say which options are others today; one that was not there did nothing."""
    idle = {*RUNNING}
    if not today.get("controls.run"):
        idle |= {name for name in today if name.startswith("controls.")}
    for name in sorted((then.keys() | today.keys()) - idle):
        if name not in today:
            yield f"{name}={then[name]} (now there is none)"
        elif name not in then and today[name]:
            yield f"no {name} (now {today[name]})"
        elif name in then and then[name] != today[name]:
            yield f"{name}={then[name]} (now {today[name]})"
