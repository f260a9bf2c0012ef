"""What the entries of a configuration are: bends, torsion, shear and elongations, section by section."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby

import torch
from torch import Tensor

from apcc_torch.settings import Setting


@dataclass(frozen=True)
class Coordinate:
    """One entry of a section's configuration.

    name: In words.
    unit: "rad" or "m".
    driven: Whether the tendons move it. What they do not, the load moves: it is inferred, and never commanded.

    Example:
        >>> Coordinate("torsion", "rad", driven=False).stretches
        False
    """

    name: str
    unit: str
    driven: bool = True

    @property
    def stretches(self) -> bool:
        """Whether it is a section's elongation."""
        return self.name == "elongation"


BEND_X = Coordinate("bend x", "rad")
BEND_Y = Coordinate("bend y", "rad")
ELONGATION = Coordinate("elongation", "m")

Index = slice | list[int]


@dataclass(frozen=True)
class Coordinates:
    """Entries of a configuration q (..., n): a pattern that repeats along q.

    pattern: The coordinates of one section where all sections have the same, else those of the whole arm, in order.
        Every section has one `ELONGATION`, its last.

    Example:
        >>> coordinates = AffineBackbone(2).coordinates
        >>> coordinates.names(10)[:5]
        ['bend x 1', 'bend y 1', 'slope x 1', 'slope y 1', 'elongation 1']
        >>> torch.arange(10)[coordinates.elongations]
        tensor([4, 9])
    """

    pattern: tuple[Coordinate, ...]

    @property
    def period(self) -> int:
        """Entries of the pattern."""
        return len(self.pattern)

    @property
    def elongations(self) -> Index:
        """Where the elongations are in q, one a section: q[..., elongations]."""
        places = self._places(lambda c: c.stretches)
        return slice(places[0], None, self.period) if len(places) == 1 else places

    @property
    def angular(self) -> Index:
        """Where the angles are in the pattern."""
        return _compact(self._places(lambda c: c.unit == "rad"))

    @property
    def linear(self) -> Index:
        """Where the lengths are in the pattern."""
        return _compact(self._places(lambda c: c.unit == "m"))

    @property
    def all_driven(self) -> bool:
        """Whether the tendons move every coordinate."""
        return all(c.driven for c in self.pattern)

    def _places(self, holds: Callable[[Coordinate], bool]) -> list[int]:
        return [i for i, c in enumerate(self.pattern) if holds(c)]

    def names(self, n: int) -> list[str]:
        """Names of n entries, sections counted from 1: "bend x 1"."""
        names, section = [], 1
        for c in self.pattern * (n // self.period):
            names.append(f"{c.name} {section}")
            section += c.stretches
        return names

    def of_pattern(self, q: Tensor) -> Tensor:
        """q (..., n) as (..., n / period, period)."""
        return q.unflatten(-1, (-1, self.period))

    def bends(self, q: Tensor) -> Tensor:
        """(..., n_b, 2) bends x and y of the sections, rad, zero for a bend that q has not."""
        zero, rows, row = torch.zeros_like(q[..., 0]), [], {}
        for c, value in zip(self.pattern * (q.shape[-1] // self.period), q.unbind(-1), strict=True):
            row[c] = value
            if c.stretches:
                rows.append(torch.stack((row.get(BEND_X, zero), row.get(BEND_Y, zero)), dim=-1))
                row = {}
        return torch.stack(rows, dim=-2)

    def driven(self, J: Tensor) -> Tensor:
        """Columns of J (..., n), those of coordinates that the tendons do not move made zero."""
        if self.all_driven:
            return J
        columns = self.of_pattern(J).unbind(-1)
        kept = [v if c.driven else torch.zeros_like(v) for v, c in zip(columns, self.pattern, strict=True)]
        return torch.stack(kept, dim=-1).flatten(-2)

    def on_elongations(self, values: Tensor) -> Tensor:
        """(..., n) with values (..., n_b) at the elongations and zero elsewhere."""
        return self._spread(values, lambda c: c.stretches)

    def with_elongations(self, q: Tensor, values: Tensor) -> Tensor:
        """q (..., n) with values (..., n_b) in place of its elongations."""
        places = self.on_elongations(torch.ones_like(values)) > 0.0
        return torch.where(places, self.on_elongations(values), q)

    def on_bends(self, values: Tensor) -> Tensor:
        """(..., n) with values (..., n_b) at the bends of their sections and zero elsewhere."""
        return self._spread(values, lambda c: c in (BEND_X, BEND_Y))

    def from_bends(self, x: Tensor, y: Tensor) -> Tensor:
        """(..., n) with bends x and y (..., n_b), rad, and zero elsewhere; see `bends`."""
        return self._spread(x, lambda c: c == BEND_X) + self._spread(y, lambda c: c == BEND_Y)

    def _spread(self, values: Tensor, holds: Callable[[Coordinate], bool]) -> Tensor:
        """(..., n) with values (..., n_b), one a section, where `holds`, and zero elsewhere."""
        many = sum(c.stretches for c in self.pattern)
        of_section = [values] if many == 1 else values.unflatten(-1, (-1, many)).unbind(-1)
        zero, section, entries = torch.zeros_like(of_section[0]), 0, []
        for c in self.pattern:
            entries.append(of_section[section] if holds(c) else zero)
            section += c.stretches  # a section's elongation is its last coordinate
        return torch.stack(entries, dim=-1).flatten(-2)

    def per_unit(self, angle: Setting, length: Setting, n: int, like: Tensor) -> Tensor:
        """(..., n) with `angle` at the angles and `length` at the lengths; each a number or (...), one a row."""
        repeats = n // self.period
        if isinstance(angle, Tensor) or isinstance(length, Tensor):
            both = (torch.as_tensor(v, dtype=like.dtype, device=like.device) for v in (angle, length))
            angles, lengths = torch.broadcast_tensors(*both)
            one = torch.stack([angles if c.unit == "rad" else lengths for c in self.pattern], dim=-1)
            return one.unsqueeze(-2).expand(*one.shape[:-1], repeats, self.period).flatten(-2)
        runs = [(unit, len(list(run))) for unit, run in groupby(c.unit for c in self.pattern)]
        parts = [
            torch.full((repeats, many), angle if unit == "rad" else length, dtype=like.dtype, device=like.device)
            for unit, many in runs
        ]
        return torch.cat(parts, dim=-1).flatten()


def _compact(places: list[int]) -> Index:
    """The places as a slice where they are one run."""
    if places and places == list(range(places[0], places[-1] + 1)):
        return slice(places[0], places[-1] + 1)
    return places


CONSTANT_CURVATURE = Coordinates((BEND_X, BEND_Y, ELONGATION))
"""(Delta_x rad, Delta_y rad, delta L m) a section."""
