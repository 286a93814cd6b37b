"""Randomness as a function of a seed and a name, so that any iteration can be repeated alone."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

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


Generators = torch.Generator | Sequence[torch.Generator] | None
"""Where random rows come from: one generator (None is the global one), or several in turn."""


def draw_rows(
    draw: Callable[[int, torch.Generator | None], Tensor], n: int, source: Generators
) -> Tensor:
    """Return ``draw(n, generator)``, or of several generators what each draws, its share of n.

    >>> pair = [generator(0, "left"), generator(0, "right")]
    >>> rows = draw_rows(lambda n, g: torch.rand(n, 2, generator=g), 6, pair)
    >>> bool((rows[3:] == torch.rand(3, 2, generator=generator(0, "right"))).all())
    True
    """
    if source is None or isinstance(source, torch.Generator):
        return draw(n, source)
    return torch.cat([draw(n // len(source), each) for each in source])
