"""Randomness as a function of a seed and a name, so that any iteration can be repeated alone."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

STREAMS = ("training", "validation", "evaluation")
"""Disjoint streams of scenes (choices are made on validation, results on evaluation)."""


def derive(seed: int, *names: object) -> int:
    """Return a 63-bit seed that depends on ``seed`` and on every name.

    >>> derive(0, "env") == derive(0, "env"), derive(0, "env") == derive(0, "policy")
    (True, False)
    """
    text = "/".join([str(int(seed)), *map(str, names)])
    digest = hashlib.blake2b(text.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def generator(
    seed: int, *names: object, device: torch.device | str | None = None
) -> torch.Generator:
    """Return a generator on ``device`` seeded with :func:`derive`."""
    return torch.Generator(device=device or "cpu").manual_seed(derive(seed, *names))


@dataclass(frozen=True)
class Shares:
    """Several generators, each of which draws as many rows as it would alone.

    Rows that are not looked at need not be computed with: only the first ``kept`` of every
    generator's rows are handed on, and all of them are drawn.
    """

    generators: Sequence[torch.Generator]
    """What draws."""
    rows: int
    """Rows that each of them draws at a time."""
    kept: int
    """How many of these, the first, are handed on."""

    def __len__(self) -> int:
        """Rows that all of them hand on."""
        return self.kept * len(self.generators)


Generators = torch.Generator | Shares | None
"""Where random rows come from: one generator (None is the global one), or several in turn."""


def draw_rows(
    draw: Callable[[int, torch.Generator | None], Tensor], n: int, source: Generators
) -> Tensor:
    """Return ``draw(n, generator)``, or of several generators what each draws, one after another.

    >>> pair = Shares([generator(0, "left"), generator(0, "right")], rows=3, kept=2)
    >>> rows = draw_rows(lambda n, g: torch.rand(n, 2, generator=g), 4, pair)
    >>> bool((rows[2:] == torch.rand(3, 2, generator=generator(0, "right"))[:2]).all())
    True
    """
    if not isinstance(source, Shares):
        return draw(n, source)
    if n != len(source):
        raise ValueError(f"{n} rows asked for, {len(source)} are handed on")
    return torch.cat([draw(source.rows, each)[: source.kept] for each in source.generators])
