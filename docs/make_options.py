"""The page of all options, which MkDocs completes as it builds: a hook of ``mkdocs.yml``."""

import inspect
from dataclasses import fields, is_dataclass, replace
from types import SimpleNamespace
from typing import Any

from ifo_grounding.config import Options
from ifo_grounding.options import field_docs, options_of, written
from ifo_grounding.training import FitConfig
from ifo_grounding.worlds import BabyAI, Grid, Gymnasium

SECTIONS = {f.name: f.default_factory for f in fields(Options) if is_dataclass(f.default_factory)}
WORLDS = {"world=grid": Grid, "world=babyai": BabyAI, "world=gymnasium": Gymnasium}
FITTED = [name for name, kind in SECTIONS.items() if issubclass(kind, FitConfig)]


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for each page."""
    return f"{markdown}\n{described()}" if page.file.src_uri == "options.md" else markdown


def described() -> str:
    """Return every option with its value and meaning, as Markdown."""
    composed = (options_of(f"preset={name}") for name in ("strong", "paper"))
    presets = [replace(each, run=Options.run) for each in composed]
    values = {name: [getattr(each, name) for each in presets] for name in SECTIONS}
    general = [f.name for f in fields(Options) if f.name not in (*SECTIONS, "world")]
    learning = [*field_docs(FitConfig)]
    said = f"Each in {', '.join(f'`{name}`' for name in FITTED)}, such as `imitate.lr`."
    parts = ["## General\n", listed(Options, general, "", presets)]
    parts += [f"## How networks learn\n\n{said}\n"]
    parts += [table(FitConfig, learning, "", **{name: values[name] for name in FITTED})]
    for name, kind in {**SECTIONS, **WORLDS}.items():
        shown = values.get(name) or [SimpleNamespace(**options_of(name).world)]
        if own := [n for n in field_docs(kind) if name not in FITTED or n not in learning]:
            said = (inspect.getdoc(kind) or "").partition("\n\n")[0].replace("``", "`")
            parts += [f"## {name}\n\n{said}\n"]
            parts += [listed(kind, own, f"{name.partition('=')[0]}.", shown)]
    return "\n".join(parts)


def listed(kind: type, names: list[str], above: str, values: list) -> str:
    """Return a line for each option, which a narrow screen can break."""
    docs = field_docs(kind)
    return "".join(f"- **`{above}{n}`** = {shown(values, n)}: {docs[n]}\n" for n in names)


def table(kind: type, names: list[str], above: str, **columns: list) -> str:
    docs, head = field_docs(kind), ["option", *columns, "meaning"]
    rows = [[f"`{above}{n}`", *(shown(v, n) for v in columns.values()), docs[n]] for n in names]
    lines = (" | ".join(row) for row in [head, ["---"] * len(head), *rows])
    return "".join(f"| {line} |\n" for line in lines)


def shown(values: list, name: str) -> str:
    texts = dict.fromkeys(written(getattr(each, name)) for each in values)
    return " / ".join(f"`{text}`" for text in texts)
