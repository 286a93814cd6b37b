"""The one exception for mistakes that a caller can mend."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any

from ifo_grounding.texts import one_line


class UserError(ValueError):
    """Bad input: says what was wrong, what is allowed and what to do, in one line."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(message))  # of what others say, such as Arrow, there are many


def check_choice(name: str, value: object, allowed: Iterable[object]) -> None:
    """Raise :class:`UserError` unless ``value`` is one of ``allowed``.

    >>> check_choice("task", "fly", ["move", "pick"])
    Traceback (most recent call last):
    ifo_grounding.errors.UserError: unknown task 'fly': choose one of 'move', 'pick'
    """
    options = list(allowed)
    if value not in options:
        hint = did_you_mean(str(value), [each for each in options if isinstance(each, str)])
        listed = ", ".join(repr(option) for option in options if option is not None)
        raise UserError(f"unknown {name} {value!r}{hint}: choose one of {listed}")


def whole(name: str, value: object) -> int:
    """Return a whole number, or refuse what is none, such as 1e3 or True."""
    if not isinstance(value, bool):
        with contextlib.suppress(TypeError):
            return operator.index(value)  # type: ignore[arg-type]
    raise UserError(f"{name} must be a whole number, got {value!r}")


def at_least_one(name: str, value: object) -> int:
    """Return a whole number that counts something, or refuse what is none."""
    number = whole(name, value)
    if not 1 <= number < 2**63:
        bound = "at least 1" if number < 1 else "below 2**63"
        raise UserError(f"{name} must be {bound}, got {number}")
    return number


def share(name: str, value: Any, full: bool = True) -> float:
    """Return a share or a probability, or refuse what is no number within 0..1, or ``full``.

    >>> share("fraction", 1.5)
    Traceback (most recent call last):
    ifo_grounding.errors.UserError: fraction must be within 0..1, got 1.5
    """
    with contextlib.suppress(TypeError, ValueError, RuntimeError):  # no number, or several
        number = math.nan if isinstance(value, str | bytes) else float(value)
        if 0 <= number <= 1 and (full or number < 1):
            return number
    raise UserError(f"{name} must be within 0..1{'' if full else ', below 1'}, got {value!r:.40}")


def check_below(what: str, values: Any, count: int) -> None:
    """Refuse an integer tensor that holds other numbers than ``0 .. count - 1``.

    >>> import torch
    >>> check_below("actions hold", torch.tensor([3, 9]), 6)
    Traceback (most recent call last):
    ifo_grounding.errors.UserError: actions hold 9: allowed are 0..5
    """
    if values.numel():
        low, high = (int(end) for end in values.aminmax())
        if low < 0 or high >= count:
            raise UserError(f"{what} {low if low < 0 else high}: allowed are 0..{count - 1}")


def check_numbers(config: Any, unbounded: Iterable[str] = ()) -> None:
    """Refuse values of a dataclass that are no numbers where its fields say ``int`` or ``float``.

    Those of NumPy and PyTorch become Python's, which a checkpoint can hold. Only what is named
    ``unbounded`` may be infinite.
    """
    for field in fields(config):
        value = getattr(config, field.name)
        if getattr(value, "shape", None) == ():
            value = value.item()
            object.__setattr__(config, field.name, value)  # of a frozen one, too
        if field.type == "int" or (field.type == "int | None" and value is not None):
            whole(field.name, value)
        elif field.type == "float":
            if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
                raise UserError(f"{field.name} must be a number, got {value!r}")
            if math.isinf(value) and field.name not in unbounded:
                raise UserError(f"{field.name} must be finite")


def check_range(
    config: Any,
    *names: str,
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
) -> None:
    """Refuse numbers of a dataclass that are outside of a range; None passes.

    >>> from types import SimpleNamespace
    >>> check_range(SimpleNamespace(steps=3, lr=0), "steps", "lr", above=0)
    Traceback (most recent call last):
    ifo_grounding.errors.UserError: lr must be above 0, got 0
    """
    for name in names:
        value = getattr(config, name)
        if value is None:
            continue
        if least is not None and not value >= least:
            raise UserError(f"{name} must be at least {least}, got {value}")
        if above is not None and not value > above:
            raise UserError(f"{name} must be above {above}, got {value}")
        if most is not None and not value <= most:
            raise UserError(f"{name} must be at most {most}, got {value}")


def did_you_mean(given: str, allowed: Iterable[str]) -> str:
    """Return a hint at the name that is most like the one given, empty where none is.

    >>> did_you_mean("imitat", ["label", "imitate"])
    " (did you mean 'imitate'?)"
    """
    close = difflib.get_close_matches(given, list(allowed), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def optional(module: str, extra: str) -> Any:
    """Import a module that an extra installs, or say how to install it.

    >>> optional("no_such_library", extra="video")
    Traceback (most recent call last):
    ifo_grounding.errors.UserError: no_such_library is missing: pip install 'ifo-grounding[video]'
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise UserError(f"{module} is missing: pip install 'ifo-grounding[{extra}]'") from None


def first_line(error: Exception) -> str:
    """Return an error's kind and the first line of what it says."""
    return f"{type(error).__name__}: {(str(error) or 'no reason given').splitlines()[0]}"


def check_names_of_actions(names: Sequence[str], count: int) -> None:
    """Refuse names of actions that are not one for each."""
    if len(names) != count:
        raise UserError(f"there are {count} actions and {len(names)} names: name each of them")
