"""Randomness as a function of a seed and a name, so that any iteration can be repeated alone."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ifo_grounding.errors import whole

STREAMS = ("training", "validation", "evaluation")
"""Disjoint streams of scenes (choices are made on validation, results on evaluation)."""


def derive(seed: int, *names: object) -> int:
    """Return a 63-bit seed that depends on ``seed`` and on every name.

    >>> derive(0, "env") == derive(0, "env"), derive(0, "env") == derive(0, "policy")
    (True, False)
    """
    text = "/".join([str(whole("seed", seed)), *map(str, names)])
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
    draw: Callable[..., Tensor], shape: Sequence[int], source: Generators, **options: Any
) -> Tensor:
    """Return ``draw(shape, generator=source)``; of several generators each draws its share of rows.

    >>> pair = [generator(0, "left"), generator(0, "right")]
    >>> rows = draw_rows(torch.rand, (6, 2), pair)
    >>> bool((rows[3:] == torch.rand(3, 2, generator=generator(0, "right"))).all())
    True
    """
    if source is None or isinstance(source, torch.Generator):
        return draw(shape, generator=source, **options)
    share = (shape[0] // len(source), *shape[1:])
    return torch.cat([draw(share, generator=each, **options) for each in source])
