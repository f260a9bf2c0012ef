"""Random numbers that belong to a row: draw k of row i is a function of the row's key and of k alone.

A generator shared by the rows would give a row other numbers as soon as another row draws. Here each row counts its own
draws, so which rows reset together, how many rows there are, and where they are computed, changes no row's numbers.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import torch
from torch import Tensor

# Steele, Lea and Flood's SplitMix64: the increment and the two factors of its finalizer, as signed 64-bit integers.
_INCREMENT = 0x9E3779B97F4A7C15 - 2**64
_FACTORS = (0xBF58476D1CE4E5B9 - 2**64, 0x94D049BB133111EB - 2**64)


class Stream(NamedTuple):
    """Where each row's stream stands.

    key: (N,) int64, what tells the streams apart.
    drawn: (N,) int64, how many numbers it has given.
    """

    key: Tensor
    drawn: Tensor

    def uniform(self, n: int, dtype: torch.dtype) -> tuple[Stream, Tensor]:
        """The stream after n draws, and the draws (N, n), uniform in [0, 1)."""
        index = self.drawn.unsqueeze(-1) + torch.arange(n, device=self.key.device)
        bits = _mixed(self.key.unsqueeze(-1) + (index + 1) * _INCREMENT)
        # The upper 53 bits fill a double's mantissa.
        draws = _shifted(bits, 11).double() * 2.0**-53
        return Stream(self.key, self.drawn + n), draws.to(dtype)

    def normal(self, n: int, dtype: torch.dtype) -> tuple[Stream, Tensor]:
        """The stream after 2 n draws, and n standard normal numbers (N, n) of them, by Box and Muller."""
        later, draws = self.uniform(2 * n, torch.float64)
        radius = torch.sqrt(-2.0 * torch.log1p(-draws[..., :n]))
        return later, (radius * torch.cos(2.0 * pi * draws[..., n:])).to(dtype)


def streams(seed: int, rows: int, device: torch.device) -> Stream:
    """Fresh streams of N rows; row i's is the same whatever the number of rows.

    Args:
        seed: 0 to 2^63 - 1.
        rows: N.
        device: Where they live.
    """
    start = _mixed(torch.tensor(seed, dtype=torch.int64, device=device))
    keys = _mixed(start + torch.arange(1, rows + 1, device=device) * _INCREMENT)
    return Stream(keys, torch.zeros_like(keys))


def _shifted(bits: Tensor, n: int) -> Tensor:
    """Right shift that fills with zeros: that of a signed integer fills with its sign."""
    return (bits >> n) & ((1 << (64 - n)) - 1)


def _mixed(bits: Tensor) -> Tensor:
    """SplitMix64's finalizer; products wrap around modulo 2^64."""
    bits = (bits ^ _shifted(bits, 30)) * _FACTORS[0]
    bits = (bits ^ _shifted(bits, 27)) * _FACTORS[1]
    return bits ^ _shifted(bits, 31)
