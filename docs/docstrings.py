"""Docstrings for the API pages: examples become sections, roles plain code, maths maths."""

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):`~?([\w.]+)`")
MATH = re.compile(r"^\.\. math:: (.+)$", re.MULTILINE)


def rewrite(text: str) -> str:
    """Indent bare examples under an ``Examples:`` heading, which the page renders as code."""
    text = ROLE.sub(r"`\1`", text)
    text = MATH.sub(lambda found: f"\\[ {found[1]} \\]", text)
    lines, inside = [], False
    for line in text.splitlines():
        starts = line.startswith(">>> ")
        if starts and not inside:
            lines += ["Examples:"]
        inside = (inside or starts) and bool(line.strip())
        lines.append(f"    {line}" if inside else line)
    return "\n".join(lines)


class Docstrings(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for each object once it is loaded."""
        if obj.docstring:
            obj.docstring.value = rewrite(obj.docstring.value)
