"""Options of a command: composed by Hydra, checked, and those of the run that goes on."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ifo_grounding.cli import recipes_folder
from ifo_grounding.config import FREE, Options, register
from ifo_grounding.data import Demonstrations
from ifo_grounding.data.pictures import LIST, read_list
from ifo_grounding.errors import UserError, did_you_mean
from ifo_grounding.training.checkpoint import leaves
from ifo_grounding.training.run import Run

FEW = 1000
"""With fewer demonstrations than this, the budget of ``strong`` is ``few``, unless one is named."""
LARGEST = 2**31 - 1
"""Of whole numbers that are no seeds."""
CONFIG = "config"
"""Name of the YAML that all recipes begin with."""

register()


def options_of(*overrides: str) -> Options:
    """Return the options that a command line of ``name=value`` stands for.

    Raises:
        UserError: with the option, what was given and what is allowed.

    >>> options_of("task=pick", "budget=tiny", "seed=3").run
    'pick-strong-tiny-seed3'
    """
    try:
        with initialize_config_dir(version_base=None, config_dir=str(recipes_folder() / "conf")):
            return settled(compose(CONFIG, list(overrides)), overrides)
    except UserError:
        raise
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise explained(error) from None


def current(cfg: DictConfig) -> Options:
    """Return the options of the job that Hydra runs."""
    return settled(cfg, HydraConfig.get().overrides.task)


def settled(cfg: DictConfig, overrides: Sequence[str]) -> Options:
    """Return composed options as dataclasses: those of the run, where it has begun.

    With fewer demonstrations than :data:`FEW` the budget of ``strong`` is
    ``few``, unless one is named. What a run was made with wins over what a command does not name,
    but for what decides nothing of what it learns (:data:`~ifo_grounding.config.FREE`); what it
    names otherwise is refused where the run is opened.
    """
    _refuse_unknown(cfg)
    named = [each.key_or_group for each in OverridesParser.create().parse_overrides([*overrides])]
    number = _demonstrations(cfg)
    if number < FEW and cfg.preset == "strong" and "budget" not in named:
        cfg = compose(CONFIG, [*overrides, "budget=few"])
    cfg.demonstrations.n = number  # all that were recorded, not as many as the budget would record
    made = Run(cfg.run).options()
    return typed(cfg if made is None else _goes_on(cfg, made, named))


def _demonstrations(cfg: DictConfig) -> int:
    """Return how many demonstrations are asked for: no more than were recorded elsewhere."""
    asked = int(cfg.demonstrations.n)
    if not cfg.recorded:
        return asked
    folder = Path(cfg.recorded)
    if not folder.is_dir():
        raise UserError(f"recorded={folder} is no folder of demonstrations")
    return min(
        asked, len(read_list(folder) if (folder / LIST).exists() else Demonstrations.load(folder))
    )


def _goes_on(cfg: DictConfig, made: dict[str, Any], named: Sequence[str]) -> DictConfig:
    """Return a run's options, but for those that are free and those that a command names."""
    known = leaves(plain(cfg))
    for name in leaves(made):
        if name not in known and not name.startswith("world."):
            raise UserError(
                f"{cfg.run} was made with the option {name}, which this version does not have: "
                "give another run=, or go on with the version that made it"
            )
    result = OmegaConf.create({**plain(cfg), **made})
    for name in [*FREE, *named]:
        if not name.startswith("hydra"):
            OmegaConf.update(result, name, plain(OmegaConf.select(cfg, name)), merge=False)
    return result


def typed(cfg: DictConfig) -> Options:
    """Return options as dataclasses, whose ranges are checked.

    Raises:
        UserError: with the option, what was given and what is allowed.
    """
    values = plain(cfg)
    options = {}
    for field in dataclasses.fields(Options):
        value = values[field.name]
        kind: Any = field.default_factory
        if dataclasses.is_dataclass(kind):
            try:
                value = kind(**value)  # type: ignore[operator]
            except UserError as error:
                raise UserError(_placed(str(error), field.name)) from None
        options[field.name] = value
    for name, value in leaves(values).items():
        if isinstance(value, int) and abs(value) > LARGEST and not name.endswith("seed"):
            raise UserError(f"{name} must be at most {LARGEST:,}, got {value}")
    return Options(**options)


def _placed(error: str, section: str) -> str:
    """Say in which section the option is that an error begins with."""
    unknown = error.removeprefix("unknown ")
    return f"{section}.{error}" if unknown == error else f"unknown {section}.{unknown}"


def plain(node: Any) -> Any:
    """Return options as dicts, lists and numbers."""
    if dataclasses.is_dataclass(node) and not isinstance(node, type):
        return dataclasses.asdict(node)
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def _refuse_unknown(cfg: DictConfig) -> None:
    """Refuse what was added to the options, or removed, that a dataclass describes."""
    known = {field.name: field for field in dataclasses.fields(Options)}
    for name in [*cfg, *known]:
        if name not in known:
            raise UserError(f"unknown option {name!r}{did_you_mean(str(name), known)}")
        if name not in cfg:
            raise UserError(f"option {name!r} is needed: do not remove it")
        kind: Any = known[str(name)].default_factory
        if dataclasses.is_dataclass(kind):
            fields = {field.name for field in dataclasses.fields(kind)}
            for wrong in fields.symmetric_difference(map(str, cfg[name])):
                raise UserError(f"option {name}.{wrong} cannot be added or removed")


def explained(error: Exception) -> UserError:
    """Return what was wrong with options, what was given and what is allowed, in one line."""
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    if isinstance(error, MissingConfigException) and error.options:
        group, _, given = str(error.missing_cfg_file).rpartition("/")
        allowed = [name for name in error.options if not name.endswith("Options")]
        hint = did_you_mean(given, allowed)
        return UserError(f"unknown {group} {given!r}{hint}: choose one of {', '.join(allowed)}")
    if isinstance(cause, (ConfigKeyError, ConfigAttributeError)) and cause.full_key:
        section, _, name = cause.full_key.rpartition(".")
        parent = cause.parent_node
        names = sorted({*map(str, parent or ())} - {"hydra"})
        where = f"{section!r} has" if section else "there are"
        hint = did_you_mean(name, names)
        return UserError(f"unknown option {cause.full_key!r}{hint}: {where} {', '.join(names)}")
    said = str(cause).splitlines()[0]
    if isinstance(cause, OmegaConfBaseException) and cause.full_key:
        return UserError(f"option {cause.full_key}: {said[:1].lower()}{said[1:]}")
    return UserError(f"{said}: options are written name=value; see --help")


def help_text(recipe: str, cfg: DictConfig) -> str:
    """Return all options with their values and what they mean, section by section."""
    kind: Any = OmegaConf.get_type(cfg)
    lines = [
        f"{recipe}: options are written name=value, those of a section section.name=value.",
        "",
    ]
    for group in ("preset", "budget", "world") if kind is Options else ():
        files = (recipes_folder() / "conf" / group).glob("*.yaml")
        lines.append(f"  {group}: {', '.join(sorted(path.stem for path in files))}")
    return "\n".join([*lines, "", *described(kind, plain(cfg))])


def described(kind: type, values: dict[str, Any], above: str = "") -> Iterator[str]:
    """Write the options of a dataclass, those with options of their own last."""
    docs = field_docs(kind)
    fields = dataclasses.fields(kind)
    sections = [each for each in fields if isinstance(values[each.name], dict)]
    for each in (*(each for each in fields if each not in sections), *sections):
        value, name = values[each.name], f"{above}{each.name}"
        if each in sections:
            inner: Any = each.default_factory
            inner = inner if dataclasses.is_dataclass(inner) else None
            heading = inspect.getdoc(inner) if inner else docs.get(each.name, "")
            yield f"\n{name}: {' '.join(str(heading).split())}"
            if inner:
                yield from described(inner, value, f"{name}.")
            else:
                yield from (f"  {name}.{key}={_written(value[key])}" for key in value)
            continue
        text = f"{name}={_written(value)}"
        meaning = textwrap.wrap(docs.get(each.name, ""), 62) or [""]
        fits = len(text) <= 36
        yield f"  {text:<36}  {meaning[0]}".rstrip() if fits else f"  {text}"
        yield from (f"{'':<40}{more}" for more in meaning[fits:])


def _written(value: Any) -> str:
    """Write a value as it is given on a command line."""
    return (
        {None: "null", True: "true", False: "false"}[value]
        if value is None or isinstance(value, bool)
        else str(value)
    )


def field_docs(kind: type) -> dict[str, str]:
    """Return what stands below each field of a dataclass, inherited ones included.

    >>> from ifo_grounding.training import FitConfig
    >>> field_docs(FitConfig)["batch_size"]
    'Samples per step.'
    """
    found: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(each):
            continue
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(each))).body
        assert isinstance(body, ast.ClassDef)
        for field, below in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                assert isinstance(field.target, ast.Name)
                text = " ".join(str(ast.literal_eval(below.value)).split())
                found[field.target.id] = text.replace("``", "`")
    return found
