"""What ``--help`` says of a recipe: its options, their values, and what each of them means."""

from __future__ import annotations

import ast
import functools
import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from omegaconf import DictConfig

OPTION = re.compile(r"(?P<indent> *)(?P<name>[\w-]+):(?P<value>.*?)(?:\s#\s*(?P<meaning>.*))?$")
WIDTH, COLUMN = 100, 36
"""Of the text, and where meanings begin."""


def help_text(conf: Path, name: str, overrides: Sequence[str] = ()) -> str:
    """Return the options of a recipe, with their values under ``overrides`` and their meanings.

    A meaning is the comment behind an option in the files that make up its value; where there is
    none, what the dataclass says that the option goes to; and else the comment that another choice,
    such as another preset, has behind it.

    Args:
        conf: folder of the options.
        name: of the recipe.
        overrides: ``name=value``, checked before.

    >>> from ifo_grounding._folder import recipes_folder
    >>> text = help_text(recipes_folder() / "conf", "imitate", ["seed=3"])
    >>> [line.split() for line in text.splitlines() if line.startswith("seed")]
    [['seed:', '3', '#', 'of', 'all', 'randomness']]
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.singleton import Singleton
    from omegaconf import OmegaConf

    before = Singleton.get_state()
    with initialize_config_dir(version_base=None, config_dir=str(conf), job_name=name):
        options = compose(name, overrides=list(overrides), return_hydra_config=True)
        HydraConfig.instance().set_config(options)  # what the name of a run is made of
        choices = {
            group: chosen
            for group, chosen in options.hydra.runtime.choices.items()
            if (conf / group).is_dir() and chosen
        }
        groups = GlobalHydra.instance().config_loader()
        offered = [f"  {group}: {', '.join(groups.get_group_options(group))}" for group in choices]
    known = meanings(conf, name, choices)
    OmegaConf.set_struct(options, False)
    del options["hydra"]
    lines = [f"{name}: options are written name=value, those of a section section.name=value.", ""]
    if offered:
        lines += ["Choices:", *offered, ""]
    lines += ["Options, their values and what they mean:", ""]
    lines += _described(options, known)
    Singleton.set_state(before)
    return "\n".join(lines)


def meanings(conf: Path, name: str, choices: Mapping[str, str]) -> dict[str, str]:
    """Return what the options of a recipe mean, by their names with dots."""
    of_others: dict[str, str] = {}
    for group in choices:
        for file in sorted((conf / group).glob("*.yaml"), reverse=True):
            of_others |= _comments(conf, file, choices)
    of_fields = {
        f"{section}.{field}": said
        for section, kind in _sections().items()
        for field, said in field_docs(kind).items()
    }
    return of_others | of_fields | _comments(conf, conf / f"{name}.yaml", choices)


def _sections() -> dict[str, Any]:
    """Return the dataclasses that sections of options go to."""
    from ifo_grounding.networks import NetworkConfig
    from ifo_grounding.training import FitConfig, SelfExaminationConfig
    from ifo_grounding.world import Layout

    learned = ("inverse", "imitate", "instruction", "reward", "goal")
    return {
        **dict.fromkeys(learned, FitConfig),
        "self_examine": SelfExaminationConfig,
        "networks": NetworkConfig,
        "world.layout": Layout,
    }


@functools.cache
def field_docs(kind: type) -> dict[str, str]:
    """Return the first sentence below each field of a dataclass.

    >>> from ifo_grounding.training import FitConfig
    >>> field_docs(FitConfig)["batch_size"]
    'samples per step'
    """
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, below in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
            assert isinstance(field.target, ast.Name)
            text = " ".join(str(ast.literal_eval(below.value)).split()).replace("``", "`")
            first = re.split(r"\.(?= [A-Z]|$)", text)[0]
            found[field.target.id] = first[:1].lower() + first[1:]
    return found


def _comments(conf: Path, file: Path, choices: Mapping[str, str]) -> dict[str, str]:
    """Return the comments behind the options of a file, and of the files that it builds on."""
    from omegaconf import OmegaConf

    found: dict[str, str] = {}
    for entry in OmegaConf.select(OmegaConf.load(file), "defaults") or []:
        if isinstance(entry, str):
            if entry != "_self_":
                found |= _comments(conf, file.with_name(f"{entry}.yaml"), choices)
            continue
        for group in map(str, entry):
            if group in choices:
                found |= _comments(conf, conf / group / f"{choices[group]}.yaml", choices)
    path: list[str] = []
    for line in file.read_text().splitlines():
        if option := OPTION.match(line):
            path = [*path[: len(option["indent"]) // 2], option["name"]]
            if option["meaning"]:
                found[".".join(path)] = option["meaning"].strip()
    return found


def _described(section: DictConfig, known: Mapping[str, str], path: str = "") -> Iterator[str]:
    """Write the options of a section, those with options of their own last, and their meanings."""
    from omegaconf import DictConfig

    indent = " " * (2 * path.count("."))
    values = {name: _value(section, name) for name in map(str, section)}
    for name, value in sorted(values.items(), key=lambda each: isinstance(each[1], DictConfig)):
        inner = isinstance(value, DictConfig)
        line = f"{indent}{name}:" if inner else f"{indent}{name}: {_written(value)}"
        said = textwrap.wrap(known.get(path + name, ""), WIDTH - COLUMN - 2)
        if not said or len(line) >= COLUMN:
            yield line
        else:
            yield f"{line:<{COLUMN}}# {said.pop(0)}"
        yield from (f"{'':<{COLUMN}}# {more}" for more in said)
        if inner:
            yield from _described(value, known, f"{path}{name}.")


def _value(section: DictConfig, name: str) -> Any:
    """Return the value of an option, or by what it is computed where only a run can."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        return section[name]
    except OmegaConfBaseException:
        return OmegaConf.to_container(section, resolve=False)[name]  # type: ignore[call-overload, index]


def _written(value: Any) -> str:
    """Write a value as it is given on the command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(_written, value))}]"
    return str(value)
