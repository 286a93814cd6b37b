"""Options on a command line: what a recipe does not offer is refused before it begins."""

from __future__ import annotations

import contextlib
import io
import itertools
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ifo_grounding import _folder
from ifo_grounding.errors import UserError, did_you_mean

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override
    from omegaconf import DictConfig

_TAKES = {bool: "true or false", int: "a whole number", float: "a number", list: "a list"}
_NUMBERS = ("prior", "checkpoint_seconds")
"""Options that take any number, though their values so far are whole."""
_ALSO = {"pairs": None, "removal_rate": "estimated"}
"""What options of numbers take, too."""


def check_options(conf: Path, name: str, arguments: Sequence[str]) -> Namespace:
    """Return arguments as Hydra reads them.

    Raises:
        UserError: for the first that the options do not offer.
    """
    from hydra import initialize_config_dir

    flags = _parse_flags(arguments)
    name = flags.config_name or name
    conf = Path(flags.config_path or conf).absolute()
    if not (conf / f"{name}.yaml").is_file():
        listed = ", ".join(sorted(path.stem for path in conf.glob("[!_]*.yaml")))
        raise UserError(f"there are no options named {name!r} in {conf}: choose one of {listed}")
    if flags.config_dir is not None or flags.hydra_help:
        return flags
    with initialize_config_dir(version_base=None, config_dir=str(conf), job_name=name):
        _check_overrides(name, flags.overrides, several=flags.multirun)
    return flags


def _parse_flags(arguments: Sequence[str]) -> Namespace:
    from hydra._internal.utils import get_args_parser

    said = io.StringIO()
    parser = get_args_parser()
    try:
        with contextlib.redirect_stderr(said):
            flags, unknown = parser.parse_known_args(arguments)
    except SystemExit as exit_:
        if not exit_.code:
            raise
        raise UserError(said.getvalue().rpartition("error: ")[2]) from None
    unknown = [text for text in unknown if text.startswith("-")] or unknown
    if unknown and "=" in unknown[0] and not unknown[0].startswith("-"):
        raise UserError(f"{unknown[0]!r} stands after a flag: put flags before all options")
    if unknown:
        raise UserError(f"unknown flag {unknown[0]!r}: options are written name=value; see --help")
    return flags


def _check_overrides(name: str, texts: Sequence[str], several: bool) -> None:
    from hydra import compose
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    loader = GlobalHydra.instance().config_loader()
    parser = OverridesParser.create(config_loader=loader)
    groups, values = [], []
    for text in texts:
        try:
            (override,) = parser.parse_overrides([text])
        except HydraException:
            raise UserError(f"cannot read {text!r}: options are written name=value") from None
        key = override.key_or_group
        if override.is_sweep_override() and not several:
            raise UserError(f"option {key!r} got several values: add --multirun to run each")
        allowed = loader.get_group_options(key)
        if allowed and not override.is_delete():
            _check_choices(override, allowed)
            groups.append(override)
        elif not override.is_hydra_override():
            values.append(override)
    for group in groups:
        if not group.is_sweep_override():
            _check_group(name, group)
    chosen = [group.input_line or "" for group in groups if not group.is_sweep_override()]
    defaults = compose(name, overrides=chosen)
    choices = [group for group in loader.list_groups("") if group != "hydra"]
    for override in values:
        _check_value(defaults, override, choices)
    whole = [each.input_line or "" for each in values if not each.is_sweep_override()]
    try:
        compose(name, overrides=[*chosen, *whole])
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(str(error)) from None
    if several and "run" in defaults:
        _check_apart(name, [*groups, *values])


def _check_apart(name: str, overrides: Sequence[Override]) -> None:
    """Refuse a sweep of which one run would overwrite another."""
    from hydra import compose
    from hydra.core.hydra_config import HydraConfig
    from omegaconf.errors import OmegaConfBaseException

    swept = [each for each in overrides if each.is_sweep_override()]
    if not all(each.is_discrete_sweep() for each in swept):
        return  # how many there will be is not known here
    if all(each.key_or_group.startswith("evaluate.") for each in swept):
        return  # looks at one run
    options = [
        [f"{each.get_key_element()}={text}" for text in each.sweep_string_iterator()]
        if each.is_sweep_override()
        else [each.input_line or ""]
        for each in overrides
    ]
    runs: dict[str, tuple[str, ...]] = {}
    for job in itertools.product(*options):
        composed = compose(name, overrides=list(job), return_hydra_config=True)
        known = HydraConfig.instance()
        known.set_config(composed)
        try:
            run = str(composed.run)
        except OmegaConfBaseException:
            return  # its name is composed of what only a run knows
        finally:
            known.cfg = None
        if run in runs:
            apart = set(job) ^ set(runs[run])
            key = next((text.partition("=")[0] for text in job if text in apart), "seed")
            raise UserError(
                f"several jobs of this sweep are the run {run!r}: name them apart, such as "
                f"run='NAME-${{{key}}}-seed${{seed}}'"
            )
        runs[run] = job


def _check_group(name: str, override: Override) -> None:
    """Refuse a choice that other recipes offer and this one does not."""
    from hydra import compose
    from hydra.errors import HydraException

    try:
        compose(name, overrides=[override.input_line or ""])
    except HydraException:
        group, names = override.key_or_group, list(map(str, compose(name)))
        hint, listed = did_you_mean(group, names), ", ".join(names)
        raise UserError(f"{name} has no option {group!r}{hint}: it has {listed}") from None


def _check_choices(override: Override, allowed: list[str]) -> None:
    for choice in _values(override):
        if isinstance(choice, str) and choice not in allowed:
            listed = ", ".join(allowed)
            raise UserError(f"unknown {override.key_or_group} {choice!r}: choose one of {listed}")


def _check_value(defaults: DictConfig, override: Override, choices: list[str]) -> None:
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    key = override.key_or_group
    if override.is_add() or override.is_force_add():
        _check_added(key)
        return
    section, name = _locate(defaults, key, choices)
    if override.is_delete():
        return
    if OmegaConf.is_missing(section, name):
        return  # what is required has no kind of its own
    try:
        default = section[name]
    except OmegaConfBaseException:
        return  # nor has what is composed of others that only a run knows
    for given in _values(override):
        _check_kind(key, name, default, given)


def _values(override: Override) -> list[Any]:
    """Return the value of an option, or each of a sweep that lists them."""
    if not override.is_sweep_override():
        return [override.value()]
    return list(override.sweep_iterator()) if override.is_discrete_sweep() else []


def _check_kind(key: str, name: str, default: Any, given: Any) -> None:
    from omegaconf import OmegaConf

    kind = list if OmegaConf.is_list(default) else float if name in _NUMBERS else type(default)
    if OmegaConf.is_dict(default) and not isinstance(given, dict):
        listed = ", ".join(map(str, default))
        raise UserError(
            f"{key!r} is a section: set one of its options with {key}.name=value ({listed})"
        )
    if name in _ALSO and given == _ALSO[name]:
        return
    if kind in _TAKES and not _fits(given, kind):
        also = f" or {_ALSO[name] or 'null'}" if name in _ALSO else ""
        raise UserError(f"option {key!r} takes {_TAKES[kind]}{also}, not {given!r}")


def _check_added(key: str) -> None:
    """Refuse to add what no options and no part of the library have a name for."""
    section, _, name = key.partition(".")
    if "." in name:
        return
    known = _sections()
    names = known.get(section, set())
    if section not in known:
        hint = did_you_mean(section, sorted(known))
    elif name and name not in names:
        hint = did_you_mean(name, sorted(names))
    else:
        return
    raise UserError(f"unknown option {key!r}{hint}: nothing would read it")


def _sections() -> dict[str, set[str]]:
    """Return what options of all recipes, and the library where it reads a section, have names for.

    By section; other options are sections of nothing.
    """
    from omegaconf import OmegaConf

    from ifo_grounding.networks import NetworkConfig
    from ifo_grounding.training import FitConfig, SelfExaminationConfig

    known: dict[str, set[str]] = {}
    for file in (_folder.recipes_folder() / "conf").rglob("*.yaml"):
        parts = OmegaConf.to_container(OmegaConf.load(file))
        for section, options in parts.items() if isinstance(parts, dict) else ():
            names = known.setdefault(str(section), set())
            names |= set(map(str, options)) if isinstance(options, dict) else set()
    read = {"networks": NetworkConfig, "self_examine": SelfExaminationConfig}
    for section, names in known.items():
        kind = read.get(section, FitConfig if "batch_size" in names else None)
        names |= {each.name for each in fields(kind)} if kind else set()
    return known


def _fits(given: Any, kind: type) -> bool:
    if kind is float:
        return isinstance(given, (int, float)) and not isinstance(given, bool)
    return type(given) is kind


def _locate(defaults: DictConfig, key: str, choices: list[str]) -> tuple[DictConfig, str]:
    """Return the section that holds an option, and the option's name there."""
    from omegaconf import OmegaConf

    section = defaults
    *path, name = key.split(".")
    for place, part in enumerate([*path, name]):
        # Names are compared as listed: asking the section itself would resolve its values.
        names = list(map(str, section.keys()))
        if part not in names:
            names = names if place else [*choices, *names]
            hint = did_you_mean(part, names)
            where = f"{'.'.join(path[:place])!r} has" if place else "there are"
            raise UserError(f"unknown option {key!r}{hint}: {where} {', '.join(names)}")
        if place < len(path):
            if OmegaConf.is_interpolation(section, part) or not OmegaConf.is_dict(section[part]):
                plain = ".".join(path[: place + 1])
                raise UserError(f"unknown option {key!r}: {plain!r} has no options of its own")
            section = section[part]
    return section, name
