"""Docstrings for the API pages: examples become sections, roles plain code, maths maths."""

import re
import textwrap
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):`~?([\w.]+)`")
EXAMPLES = re.compile(r"^>>> .*(?:\n.+)*", re.MULTILINE)
MATH = re.compile(r"^\.\. math:: (.+)$", re.MULTILINE)


def rewrite(text: str) -> str:
    """Indent bare examples under an ``Examples:`` heading, which the page renders as code."""
    text = ROLE.sub(r"`\1`", text)
    text = MATH.sub(lambda found: f"\\[ {found[1]} \\]", text)
    return EXAMPLES.sub(lambda found: f"Examples:\n{textwrap.indent(found[0], 4 * ' ')}", text)


class Docstrings(griffe.Extension):
    """Rewrites every docstring before it is parsed."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for each object once it is loaded."""
        if obj.docstring:
            obj.docstring.value = rewrite(obj.docstring.value)
