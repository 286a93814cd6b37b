"""The one exception for mistakes that a caller can mend."""

from __future__ import annotations

from collections.abc import Iterable


class UserError(ValueError):
    """Bad input: says what was wrong, what is allowed and what to do, in one line."""


def check_choice(name: str, value: object, allowed: Iterable[object]) -> None:
    """Raise :class:`UserError` unless ``value`` is one of ``allowed``.

    >>> check_choice("task", "fly", ["move", "pick"])
    Traceback (most recent call last):
    ifo_grounding.errors.UserError: unknown task 'fly': choose one of 'move', 'pick'
    """
    options = list(allowed)
    if value not in options:
        listed = ", ".join(repr(option) for option in options)
        raise UserError(f"unknown {name} {value!r}: choose one of {listed}")
