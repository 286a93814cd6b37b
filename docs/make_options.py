"""Write the page of all options: ``python docs/make_options.py`` after one has changed."""

import inspect
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from types import SimpleNamespace

from ifo_grounding.config import Options
from ifo_grounding.files import atomic_write
from ifo_grounding.options import field_docs, options_of
from ifo_grounding.training import FitConfig
from ifo_grounding.worlds import BabyAI, Grid, Gymnasium

PAGE = Path(__file__).with_name("options.md")
HEAD = """# Options

Written `name=value`, as [Recipes](recipes.md#options) shows. Values are those of `budget=demo`,
`strong` / `paper` where these presets differ; `ifo-grounding demo budget=few --help` shows others.
"""
SECTIONS = {f.name: f.default_factory for f in fields(Options) if is_dataclass(f.default_factory)}
FITTED = [name for name, kind in SECTIONS.items() if issubclass(kind, FitConfig)]


def page() -> str:
    """Return the page as Markdown."""
    composed = (options_of(f"preset={name}") for name in ("strong", "paper"))
    presets = [replace(each, run=Options.run) for each in composed]
    general = [f.name for f in fields(Options) if f.name not in (*SECTIONS, "world")]
    parts = [HEAD, "## General\n", table(Options, general, "", value=presets)]
    said = ", ".join(f"`{name}`" for name in FITTED)
    parts.append(f"## How networks learn\n\nEach in the sections {said}, such as `imitate.lr`.\n")
    learning = {name: [getattr(each, name) for each in presets] for name in FITTED}
    parts.append(table(FitConfig, [*field_docs(FitConfig)], "", **learning))
    for name, kind in SECTIONS.items():
        values = [getattr(each, name) for each in presets]
        own = set(field_docs(kind)) - set(field_docs(FitConfig) if name in FITTED else ())
        parts.append(part(name, kind, [each for each in field_docs(kind) if each in own], values))
    for kind in (Grid, BabyAI, Gymnasium):
        name = f"world={kind.__name__.lower()}"
        values = [SimpleNamespace(**options_of(name).world)]
        parts.append(part(name, kind, [*field_docs(kind)], values))
    return "\n".join(filter(None, parts))


def part(name: str, kind: type, names: list[str], values: list) -> str:
    said = (inspect.getdoc(kind) or "").partition("\n\n")[0].replace("``", "`")
    shown = table(kind, names, f"{name.partition('=')[0]}.", value=values)
    return f"## {name}\n\n{said}\n\n{shown}" if names else ""


def table(kind: type, names: list[str], above: str, **columns: list) -> str:
    docs, head = field_docs(kind), ["option", *columns, "meaning"]
    rows = [[f"`{above}{n}`", *(shown(v, n) for v in columns.values()), docs[n]] for n in names]
    lines = (" | ".join(row) for row in [head, ["---"] * len(head), *rows])
    return "".join(f"| {line} |\n" for line in lines)


def shown(values: list, name: str) -> str:
    texts = dict.fromkeys(str(getattr(each, name)) for each in values)
    words = {"None": "null", "True": "true", "False": "false"}
    return " / ".join(f"`{words.get(text, text)}`" for text in texts)


if __name__ == "__main__":
    with atomic_write(PAGE) as temporary:
        temporary.write_text(page())
