"""Randomness as a function of a seed and a name, so that any iteration can be repeated alone."""

from __future__ import annotations

import hashlib

import torch

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
