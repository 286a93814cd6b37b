"""Texts of others, such as names and instructions, where they are shown."""

from __future__ import annotations

import re

UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters, which command a terminal, and halves of characters, which nothing encodes."""
MARKUP = re.compile(r"<(?!br>)(?=[A-Za-z/!?])|(?<=\])(?=\()")
"""Where markdown takes a text for HTML, but for a line break, or for a link or a picture."""


def one_line(text: object) -> str:
    r"""Return a text in one line, without what cannot be printed.

    >>> one_line("pick\r\n \x1b[31mred")
    'pick [31mred'
    """
    return " ".join(UNPRINTABLE.sub(" ", str(text)).split())


def markdown_cell(text: object) -> str:
    r"""Return a text as a cell of a table in markdown: one line that nothing ends or marks up.

    >>> markdown_cell("a|b < c <b>d [e](f)")
    'a\\|b < c &lt;b>d [e]\\(f)'
    """
    inert = MARKUP.sub(lambda found: "&lt;" if found[0] else "\\", one_line(text))
    return inert.replace("|", r"\|")
