"""Write the page of all options: ``python docs/make_options.py`` after one has changed."""

import dataclasses
import inspect
from pathlib import Path

from ifo_grounding.config import Options
from ifo_grounding.files import atomic_write
from ifo_grounding.options import field_docs, options_of
from ifo_grounding.worlds import BabyAI, Grid, Gymnasium

PAGE = Path(__file__).with_name("options.md")
HEAD = """# Options

Written `name=value` on the command line, those of a section `section.name=value`. Values are those of
`demo` with the presets `strong` and `paper`; `ifo-grounding demo preset=paper budget=full --help`
shows those of any choice. Nothing else is an option: a name, a type or a value out of range that
is not here is refused before anything begins.
"""


def page() -> str:
    """Return the page as Markdown."""
    strong, paper = options_of(), options_of("preset=paper")
    fields = {field.name: field for field in dataclasses.fields(Options)}
    sections = {n: f for n, f in fields.items() if dataclasses.is_dataclass(f.default_factory)}
    plain = [name for name in fields if name not in sections and name != "world"]
    parts = [HEAD, "## Of all\n", table(Options, plain, strong, paper)]
    for name, field in sections.items():
        kind = field.default_factory
        parts.append(f"## {name}\n\n{inspect.getdoc(kind)}\n")
        names = [each.name for each in dataclasses.fields(kind)]
        parts.append(table(kind, names, getattr(strong, name), getattr(paper, name)))
    for kind in (Grid, BabyAI, Gymnasium):
        parts.append(f"## world={kind.__name__.lower()}\n\n{summary(kind)}\n")
        docs = field_docs(kind)
        rows = [(f"world.{n}", docs[n]) for n in (f.name for f in dataclasses.fields(kind))]
        lines = ["| option | meaning |", "| --- | --- |", *(f"| `{n}` | {d} |" for n, d in rows)]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def summary(kind: type) -> str:
    return " ".join((inspect.getdoc(kind) or "").partition("\n\n")[0].split())


def table(kind: type, names: list[str], strong: object, paper: object) -> str:
    docs = field_docs(kind)
    lines = ["| option | `strong` | `paper` | meaning |", "| --- | --- | --- | --- |"]
    for name in names:
        values = [f"`{getattr(each, name)}`".replace("None", "null") for each in (strong, paper)]
        lines.append(f"| `{name}` | {values[0]} | {values[1]} | {docs[name]} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    with atomic_write(PAGE) as temporary:
        temporary.write_text(page())
