"""Options of a command: composed by Hydra, checked, and those of the run that goes on."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import inspect
import itertools
import pkgutil
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from ifo_grounding.cli import recipes_folder
from ifo_grounding.config import PASSING, Options
from ifo_grounding.data.demonstrations import FEW
from ifo_grounding.data.recorded import count_recorded
from ifo_grounding.errors import UserError, did_you_mean
from ifo_grounding.training.checkpoint import leaves, written
from ifo_grounding.training.run import Run
from ifo_grounding.worlds import BabyAI, Grid, Gymnasium

LARGEST = 2**31 - 1  # of whole numbers that are no seeds
CONFIG = "config"
"""Name of the YAML that all recipes begin with."""
MULTIRUN = ("-m", "--multirun")
"""One job for each combination of values that options name, such as ``seed=0,1``."""
UNREAD = ("help", "hydra_help", "hydra_logging", "job_logging", "launcher", "output", "sweeper")
"""Groups of Hydra's own options, which take a third of the time to compose them."""
READ = {"world_of": "world", "build": "networks", "chosen_by": "instruction"}
"""Sections that functions of recipes read."""


def texts_of(kind: Any) -> dict[str, str]:
    """Return the options that are texts, whatever is in them, and what stands for none."""
    return {
        field.name: "null" if "None" in str(field.type) else ""
        for field in dataclasses.fields(kind)
        if str(field.type).startswith("str") and field.name not in ("preset", "budget")
    }


TEXTS = texts_of(Options)
STORE = ConfigStore.instance()
STORE.store(name="options", node=Options)
WORLDS: dict[str, Any] = {"grid": Grid, "babyai": BabyAI, "gymnasium": Gymnasium}
for world in WORLDS.values():
    node = OmegaConf.structured(world)
    with open_dict(node):
        node["_target_"] = f"ifo_grounding.worlds.{world.__name__}"
    STORE.store(group="world", name=f"{world.__name__}Options", node=node, package="world")


def options_of(*overrides: str) -> Options:
    """Return the options that a command line of ``name=value`` stands for.

    Raises:
        UserError: with the option, what was given and what is allowed.

    >>> options_of("task=pick", "budget=tiny", "seed=3").run
    'pick-strong-tiny-seed3'
    """
    with _composing(recipes_folder()):
        return _settled(overrides)


def options_of_jobs(script: Path, arguments: Sequence[str], new: bool = False) -> list[Any]:
    """Return the options of each job that a command line asks of a script, one mostly.

    A script with a ``conf/<its name>.yaml`` has options of its own. With ``new``, they are those of
    a run that has not begun.
    """
    with _composing(script.parent):
        jobs = words_of_jobs(arguments)
        if (script.parent / "conf" / f"{script.stem}.yaml").exists():
            known = compose(script.stem)
            texts = texts_of(OmegaConf.get_type(known))
            given = [[quoted(word, texts, comma="text") for word in job] for job in jobs]
            composed = [compose(script.stem, job) for job in given]
            for each in composed:
                _refuse_unknown(known, each)
            return [OmegaConf.to_object(each) for each in composed]
        return [_settled(job, new) for job in jobs]


def words_of_jobs(arguments: Sequence[str]) -> list[list[str]]:
    """Return the options of each job, as they are written on a command line."""
    words = [word for word in arguments if word not in MULTIRUN]
    return [words] if len(words) == len(arguments) else _combinations(words)


@contextlib.contextmanager
def _composing(recipes: Path) -> Iterator[None]:
    """Let Hydra read the YAML of recipes, and say what is wrong in one line."""
    try:
        with initialize_config_dir(version_base=None, config_dir=str(recipes / "conf")):
            yield
    except UserError:
        raise
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise explained(error) from None


def quoted(word: str, texts: Mapping[str, str] = TEXTS, comma: str = "unclear") -> str:
    """Return an option that is a text as Hydra takes it, whatever is in its value.

    What is quoted already stays, and null. A comma is part of the ``text``, such as a sentence, or
    ``parts`` values; an ``unclear`` one stays, too, and so do references, unless all is text.

    >>> quoted("run=2024_11_27 #1")
    "run='2024_11_27 #1'"
    """
    name, _, value = word.partition("=")
    as_it_is = value[:1] + value[1:][-1:] in ("''", '""') or value in ("", texts.get(name, value))
    if comma != "text":
        calls = re.match(r"\w+\(", value) if comma == "parts" else "," in value
        as_it_is |= "${" in value or bool(calls)
    if as_it_is:
        return word
    parts = value.split(",") if comma == "parts" else [value]
    full = [str(Path(part).expanduser()) if part.startswith("~/") else part for part in parts]
    return f"{name}={','.join(QuotedString(each, Quote.single).with_quotes() for each in full)}"


def _combinations(words: Sequence[str]) -> list[list[str]]:
    """Return every combination of the values that options name, the last option's first."""
    parsed = OverridesParser.create().parse_overrides([quoted(w, comma="parts") for w in words])
    given = [
        [f"{each.get_key_element()}={value}" for value in each.sweep_string_iterator()]
        if each.is_sweep_override()
        else [str(each.input_line)]
        for each in parsed
    ]
    return [[*job] for job in itertools.product(*given)]


def _settled(overrides: Sequence[str], new: bool = False) -> Options:
    """Return composed options as dataclasses: those of the run, or of its base, if it has begun.

    That wins over what a command does not name, but for :data:`~ifo_grounding.config.PASSING`;
    what it names otherwise is refused where the run is opened, unless it is free.
    """
    words = [quoted(word) for word in overrides]
    named = {e.key_or_group: e.value() for e in OverridesParser.create().parse_overrides(words)}
    counted = not {"demonstrations.n", "recorded", "world"}.isdisjoint(named)
    free = named.get("preset", "strong") == "strong" and "budget" not in named
    n, few = named.get("demonstrations.n"), ["budget=few"]
    main_job = ["budget=demo"] if named.get("task", "move") == "move" else few  # harder tasks
    known = few if isinstance(n, int) and n < FEW else [] if counted else main_job
    words += [f"~hydra/{group}" for group in UNREAD if "hydra" not in " ".join(named)]
    cfg = compose(CONFIG, words + known * free)
    trees: Any = plain(Options()), OmegaConf.to_container(cfg)
    _refuse_unknown(*(leaves({**tree, "world": {}}) for tree in trees))  # whose options are its own
    number = _demonstrations(cfg)
    if free and not known and number < FEW:
        cfg = compose(CONFIG, words + few)
    if counted:  # all that were recorded, not as many as the budget would record
        cfg.demonstrations.n = number
    made = None if new else Run(cfg.run).options()
    if made is None and cfg.base:
        made = Run(cfg.base).options()
        if "run" not in named:
            raise UserError(f"base={cfg.base} needs run=, the name of the new run")
    return _typed(cfg if made is None else _goes_on(cfg, made, named))


def _demonstrations(cfg: DictConfig) -> int:
    """Return how many demonstrations are asked for: no more than were recorded elsewhere."""
    asked = int(cfg.demonstrations.n)
    gone = cfg.recorded and not Path(cfg.recorded).exists() and Run(cfg.run).options()
    return min(asked, count_recorded(Path(cfg.recorded))) if cfg.recorded and not gone else asked


def _goes_on(cfg: DictConfig, made: dict[str, Any], named: Iterable[str]) -> DictConfig:
    """Return a run's options, but for those of one command and those that a command names."""
    known = leaves(plain(cfg))
    for name in leaves(made):
        if name not in known and not name.startswith("world."):
            raise UserError(
                f"{cfg.base or cfg.run} was made with the option {name}, which this version does "
                "not have: give another run=, or go on with the version that made it"
            )
    result = OmegaConf.create({**plain(cfg), **made})
    for name in [*PASSING, *named]:
        OmegaConf.update(result, name, plain(OmegaConf.select(cfg, name)), merge=False)
    return result


def _typed(cfg: DictConfig) -> Options:
    """Return options as dataclasses, whose ranges are checked."""
    if missing := sorted(OmegaConf.missing_keys(cfg)):
        raise UserError(f"option {missing[0]} has no value: give {missing[0]}=...")
    values = plain(cfg)
    for name, value in leaves(values).items():
        if isinstance(value, int) and abs(value) > LARGEST and not name.endswith("seed"):
            raise UserError(f"{name} must be at most {LARGEST:,}, got {value}")
    options = {}
    for field in dataclasses.fields(Options):
        value, kind = values[field.name], field.default_factory
        try:
            options[field.name] = kind(**value) if dataclasses.is_dataclass(kind) else value
        except UserError as error:
            raise UserError(f"{field.name}: {error}") from None
    return Options(**options)


def plain(node: Any) -> Any:
    """Return options as dicts, lists and numbers."""
    if dataclasses.is_dataclass(node) and not isinstance(node, type):
        return dataclasses.asdict(node)
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def _refuse_unknown(known: Mapping[Any, Any], given: Mapping[Any, Any]) -> None:
    """Refuse what ``+name=`` added to the options, and what ``~name`` removed."""
    for name in sorted(known.keys() ^ given.keys()):
        hint = did_you_mean(name, known) if name in given else ""
        raise UserError(f"option {name} cannot be added or removed{hint}")


def explained(error: Exception) -> UserError:
    """Return what was wrong with options, what was given and what is allowed, in one line."""
    cause = error
    if isinstance(error, HydraException) and isinstance(error.__cause__, OmegaConfBaseException):
        cause = error.__cause__  # that of an error of OmegaConf is another one under a debugger
    if isinstance(error, MissingConfigException) and error.options:
        group, _, given = str(error.missing_cfg_file).rpartition("/")
        allowed = [name for name in error.options if not name.endswith("Options")]
        hint = did_you_mean(given, allowed)
        return UserError(f"unknown {group} {given!r}{hint}: choose one of {', '.join(allowed)}")
    if isinstance(cause, (ConfigKeyError, ConfigAttributeError)) and cause.full_key:
        section, dot, option = cause.full_key.rpartition(".")
        names = sorted({*map(str, cause.parent_node or ())} - {"hydra"})
        where = f"{section!r} has" if section else "there are"
        hint = did_you_mean(cause.full_key, [f"{section}{dot}{name}" for name in names])
        for world, kind in WORLDS.items() if section == "world" else ():
            if option in {field.name for field in dataclasses.fields(kind)}:
                hint = f" (it is one of world={world})"
        return UserError(f"unknown option {cause.full_key!r}{hint}: {where} {', '.join(names)}")
    said = re.sub(r"^\w+Exception: ", "", str(cause).splitlines()[0])
    if said.startswith("Ambiguous"):
        return UserError(f"{said}: several values need --multirun, a comma in one \"'a,b'\"")
    if isinstance(cause, OmegaConfBaseException) and cause.full_key:
        return UserError(f"option {cause.full_key}: {said[:1].lower()}{said[1:]}")
    return UserError(f"{said}: options are written name=value; see --help")


def help_text(script: Path, options: Any) -> str:
    """Return the options that a recipe reads, with their values and meanings, by section."""
    name = "demo" if script.stem == "two_phase" else script.stem
    lines = [f"{name}: options are written name=value, in a section section.name=value."]
    lines += ["One without a text means what its namesake above does.", ""]
    for group in ("preset", "budget", "world") if isinstance(options, Options) else ():
        for path in sorted((recipes_folder() / "conf" / group).glob("*.yaml")):
            said = " ".join(re.findall(r"^# (.*)", path.read_text(), re.M))  # command: meaning
            lines += _row(f"{group}={path.stem}", said.partition(": ")[2])
    values, some = plain(options), isinstance(options, Options) and name != "demo"
    if some:
        text = script.read_text()
        read = {*re.findall(r"options\.(\w+)", text), *(READ[n] for n in READ if f"{n}(" in text)}
        values = {k: v for k, v in values.items() if k in read or not isinstance(v, dict)}
    lines += ["", *described(type(options), values, set())]
    return "\n".join(lines + ["", "all options: ifo-grounding demo --help"] * some)


def described(kind: type, values: dict[str, Any], said: set[str], above: str = "") -> Iterator[str]:
    """Write the options of a dataclass that have values, those with options of their own last.

    What was ``said`` of others is not said again.
    """
    docs = {n: m for n, m in field_docs(kind).items() if m not in said}
    said |= {m for n, m in docs.items() if n in values}
    there = [each for each in dataclasses.fields(kind) if each.name in values]
    fields = sorted(there, key=lambda each: isinstance(values[each.name], dict))
    for each in fields:
        value, name = values[each.name], f"{above}{each.name}"
        if isinstance(value, dict):
            inner: Any = each.default_factory
            typed = dataclasses.is_dataclass(inner)
            heading = str(inspect.getdoc(inner)) if typed else docs.get(each.name, "")
            yield f"\n{name}: {' '.join(heading.split())}"
            if typed:
                yield from described(inner, value, said, f"{name}.")
            else:
                told: dict[str, str] = {}
                with contextlib.suppress(Exception):  # whatever an own module raises
                    told = field_docs(pkgutil.resolve_name(value["_target_"]))
                for key, inner in leaves(value).items():
                    yield from _row(f"{name}.{key}={written(inner)}", told.get(key, ""))
        else:
            yield from _row(f"{name}={written(value)}", docs.get(each.name, ""))


def _row(text: str, meaning: str) -> Iterator[str]:
    """Write an option beside what it means, or above where it is long."""
    lines = [""] * (len(text) > 36) + textwrap.wrap(meaning, 62)
    yield f"  {text:<36}  {''.join(lines[:1])}".rstrip()
    yield from (" " * 40 + line for line in lines[1:])


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
