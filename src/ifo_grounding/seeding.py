"""Randomness as a function of a seed and a name, so that any iteration can be repeated alone."""

from __future__ import annotations

import hashlib

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


def generator(seed: int, *names: object) -> torch.Generator:
    """Return a generator on the CPU, seeded with :func:`derive`."""
    return torch.Generator().manual_seed(derive(seed, *names))


_GOLDEN, *_FACTORS = (
    bits - 2**64 for bits in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)
"""As int64 has these 64 bits, of which the first is 1."""


def _mixed(bits: Tensor) -> Tensor:
    """Return splitmix64 of int64 (Steele, Lea and Flood 2014); products wrap on every device."""
    bits = _shifted(bits, 30).bitwise_xor_(bits).mul_(_FACTORS[0])
    bits = _shifted(bits, 27).bitwise_xor_(bits).mul_(_FACTORS[1])
    return _shifted(bits, 31).bitwise_xor_(bits)


def _shifted(bits: Tensor, by: int) -> Tensor:
    """Shift to the right, filling with zeros; in place from then on, a fourth faster."""
    return (bits >> by).bitwise_and_((1 << 64 - by) - 1)


class Lots:
    """Random whole numbers for N rows: the same bits on every device, whatever the rows beside.

    A number depends on the key, on the row's counters and on how many its row drew before.

    Args:
        key: seed, such as :func:`derive` returns.
        counters: what tells rows apart, int64 [N] each.

    >>> both = Lots(0, torch.tensor([7, 8])).below(6, 4)
    >>> bool((both[1:] == Lots(0, torch.tensor([8])).below(6, 4)).all())
    True
    """

    def __init__(self, key: int, *counters: Tensor) -> None:
        self._row = torch.full_like(counters[0], key)
        for counter in counters:
            self._row = _mixed(self._row + (counter + 1) * _GOLDEN)
        self._drawn = 0

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._row)

    @property
    def device(self) -> torch.device:
        """Where numbers are drawn."""
        return self._row.device

    def below(self, end: int | Tensor, n: int = 1) -> Tensor:
        """Draw n numbers of 0..end - 1 for each row, int64 [N, n]; ``end`` < 2^31 broadcasts."""
        places = torch.arange(self._drawn + 1, self._drawn + n + 1, device=self.device)
        self._drawn += n
        bits = _mixed(self._row.unsqueeze(-1) + places * _GOLDEN)
        return _shifted(bits, 32).mul_(end) >> 32

    def distinct(self, end: int, n: int) -> Tensor:
        """Draw n different numbers of 0..end - 1 for each row, int64 [N, n] (Fisher and Yates)."""
        small = torch.uint8 if end <= 256 else torch.int64
        left = torch.arange(end, dtype=small, device=self.device).repeat(len(self), 1)
        turns = torch.arange(n, device=self.device)
        places = turns + self.below(end - turns, n)
        for turn in range(n):
            place, first = places[:, turn : turn + 1], left[:, turn : turn + 1].clone()
            left[:, turn : turn + 1] = left.gather(1, place)
            left.scatter_(1, place, first)
        return left[:, :n].long()
