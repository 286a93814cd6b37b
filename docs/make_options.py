"""The page of all options, which MkDocs completes as it builds: a hook of ``mkdocs.yml``."""

import inspect
from dataclasses import fields, is_dataclass, replace
from types import SimpleNamespace
from typing import Any

from ifo_grounding.config import Options
from ifo_grounding.options import WORLDS, field_docs, options_of
from ifo_grounding.report import markdown_table
from ifo_grounding.training import FitConfig
from ifo_grounding.training.checkpoint import written

SECTIONS = {f.name: f.default_factory for f in fields(Options) if is_dataclass(f.default_factory)}
UNMADE = "run=/nowhere"
"""A run of the default name may be there, made with other options."""
FITTED = [name for name, kind in SECTIONS.items() if issubclass(kind, FitConfig)]


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for each page."""
    return f"{markdown}\n{described()}" if page.file.src_uri == "options.md" else markdown


def described() -> str:
    """Return every option with its value and meaning, as Markdown."""
    composed = (options_of(f"preset={name}", "budget=demo", UNMADE) for name in ("strong", "paper"))
    presets = [replace(each, run=Options.run) for each in composed]
    values = {name: [getattr(each, name) for each in presets] for name in SECTIONS}
    general, learning = field_docs(Options), field_docs(FitConfig)
    del general["world"]  # which has sections of its own
    rows = [
        {"option": f"`{name}`", **{f: shown(values[f], name) for f in FITTED}, "meaning": meaning}
        for name, meaning in learning.items()
    ]
    said = f"Each in {', '.join(f'`{name}`' for name in FITTED)}, such as `imitate.lr`."
    parts = ["## General\n", listed(general, "", presets)]
    parts += [f"## How networks learn\n\n{said}\n", f"{markdown_table(rows)}\n"]
    worlds = {f"world={name}": kind for name, kind in WORLDS.items()}
    for name, kind in {**SECTIONS, **worlds}.items():
        of = values.get(name) or [SimpleNamespace(**options_of(name, UNMADE).world)]
        own = {n: m for n, m in field_docs(kind).items() if name not in FITTED or n not in learning}
        if own:
            said = (inspect.getdoc(kind) or "").partition("\n\n")[0].replace("``", "`")
            parts += [f"## {name}\n\n{said}\n", listed(own, f"{name.partition('=')[0]}.", of)]
    return "\n".join(parts)


def listed(meanings: dict[str, str], above: str, values: list) -> str:
    """Return a line for each option, which a narrow screen can break."""
    lines = (f"- **`{above}{n}`** = {shown(values, n)}: {meanings[n]}\n" for n in meanings)
    return "".join(lines)


def shown(values: list, name: str) -> str:
    texts = dict.fromkeys(written(getattr(each, name)) for each in values)
    return " / ".join(f"`{text}`" for text in texts)
