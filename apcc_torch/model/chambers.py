"""An arm's pressure chambers: where they run, and what their pressure does.

A chamber pushes between the ends of its section, where a tendon pulls. It has the same column of the actuation matrix
B: y = B^T q is its change of length, and u, conjugate to it, the force by which it pushes more than at its pressure of
rest. The arm's lengths are those at rest, so u may be negative, down to where a chamber has no pressure left.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from apcc_torch.errors import Checks, ConfigError, ValueRangeError
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.modes import holds
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import OURS, TURN, Settings, setting
from apcc_torch.shapes import check_finite, check_positive, check_same, check_tensor
from apcc_torch.spread import Numbers, spread

BAR = 1e5
HIGHEST = 100.0 * BAR
"""No regulator of soft arms goes so far, Pa."""


@dataclass(frozen=True, kw_only=True)
class Chambers(Settings):
    """The chambers of an arm that pressure drives; a number for all chambers, or one each. Pressures are gauge.

    Example:
        >>> arm = Arm(lengths=[0.145, 0.145], chambers=Chambers(areas=2e-4, offsets=0.015))
        >>> arm.routing().n_tendons, arm.routing().starts
        (6, tensor([0.0000, 0.0000, 0.0000, 0.1450, 0.1450, 0.1450], dtype=torch.float64))
    """

    per_section: int = setting(
        3,
        "",
        OURS,
        "chambers of a section, evenly spaced around the backbone; unless `ends` says it",
        least=1,
        most=100,
    )
    angles: tuple[float, ...] | None = setting(
        None,
        "rad",
        OURS,
        "of each around the backbone, from the section's x axis; null: evenly spaced, the first on it",
        least=-TURN,
        most=TURN,
    )
    offsets: Numbers = setting(0.015, "m", OURS, "from the backbone to where the pressure acts", above=0, most=30)
    areas: Numbers = setting(1e-4, "m^2", OURS, "on which the pressure acts along the arm", above=0, most=1)
    ends: tuple[int, ...] | None = setting(
        None, "", OURS, "section that each is in, from 1; null: per_section in every section", least=1
    )
    rest_pressure: Numbers = setting(
        0.0, "Pa", OURS, "at which the arm's lengths are measured, and about which it is driven", most=HIGHEST
    )
    min_pressure: Numbers = setting(
        0.0, "Pa", OURS, "least that may be commanded; negative: a pump sucks", least=-BAR, most=HIGHEST
    )
    max_pressure: Numbers = setting(BAR, "Pa", OURS, "greatest that may be commanded", most=HIGHEST)
    area_growth: Numbers = setting(
        0.0, "1/Pa", OURS, "by which the area grows with pressure, A (1 + growth p)", least=0
    )
    valve_time: float = setting(0.05, "s", OURS, "time constant with which the pressure follows its command", least=0)

    def check(self) -> None:
        """Raises where no chamber is named."""
        if self.angles == () or self.ends == ():
            raise ConfigError("chambers must name at least one: leave out angles and ends, or list one entry each")

    def count(self, n_sections: int) -> int:
        """Number of chambers n_a."""
        told = self.ends if self.angles is None else self.angles
        return self.per_section * n_sections if told is None else len(told)

    def check_on(self, n_sections: int) -> None:
        """Raises ConfigError or ValueRangeError where the entries do not fit each other, or so many sections."""
        n_a = self.count(n_sections)
        if self.ends is None and n_a != self.per_section * n_sections:
            raise ConfigError(
                f"chambers.angles must have {self.per_section * n_sections} entries, {self.per_section} a section, or "
                f"chambers.ends must say which section each is in, got {n_a}"
            )
        if self.ends is not None and len(self.ends) != n_a:
            raise ConfigError(f"chambers.ends must have {n_a} entries, one a chamber, got {len(self.ends)}")
        if self.ends is not None and max(self.ends) > n_sections:
            raise ConfigError(f"chambers.ends must be sections from 1 to {n_sections}, got {list(self.ends)}")
        checks = Checks()
        for name in ("offsets", "areas", "rest_pressure", "min_pressure", "max_pressure", "area_growth"):
            with checks.one():
                self._each(name, n_sections)
        checks.end()
        least, rest, most = (self._each(f"{name}_pressure", n_sections) for name in ("min", "rest", "max"))
        if not holds((least <= rest) & (rest < most)):
            raise ValueRangeError(
                "chambers.rest_pressure must be from min_pressure to below max_pressure for every chamber"
            )

    def sections(self, n_sections: int) -> tuple[int, ...]:
        """The section that each chamber is in, from 0."""
        if self.ends is not None:
            return tuple(end - 1 for end in self.ends)
        return tuple(k for k in range(n_sections) for _ in range(self.per_section))

    def _each(self, name: str, n_sections: int) -> Tensor:
        return spread(f"chambers.{name}", getattr(self, name), self.count(n_sections))

    def routing(self, lengths: Tensor) -> TendonRouting:
        """Where they run: as tendons would that act between the ends of their sections.

        Args:
            lengths: (..., n_b) of the sections, m.
        """
        n_b = lengths.shape[-1]
        own = list(self.sections(n_b))
        if self.angles is None:
            before = [own[:k].count(section) for k, section in enumerate(own)]
            values = [2.0 * pi * number / own.count(section) for number, section in zip(before, own, strict=True)]
        else:
            values = list(self.angles)
        angles = torch.tensor(values, dtype=lengths.dtype, device=lengths.device)
        ends = lengths.cumsum(-1)
        starts = (ends - lengths)[..., own]
        # The first section begins at the base, whatever rounding leaves.
        starts = torch.where(starts.abs() < 1e-12, 0.0, starts)
        return TendonRouting(angles, self._each("offsets", n_b).to(lengths), ends[..., own], "independent", starts)

    def force(self, n_sections: int) -> ChamberForce:
        """What their pressure does."""
        names = {
            "area": "areas", "growth": "area_growth", "rest": "rest_pressure",
            "least": "min_pressure", "most": "max_pressure",
        }  # fmt: skip
        return ChamberForce(**{name: self._each(key, n_sections) for name, key in names.items()})


class ChamberForce(Part):
    """Forces of chambers and the pressures that make them: A(p) p = A p (1 + growth p), less that at rest.

    Args:
        area: (..., n_a) m^2, of a chamber without pressure.
        growth: (..., n_a) 1/Pa; None for none.
        rest: (..., n_a) Pa; None for 0.
        least, most: (..., n_a) Pa, what may be commanded; None for no limit.

    Raises:
        ValueRangeError: An area is not positive, or a value is not finite.

    Example:
        >>> chambers = ChamberForce(torch.tensor([2e-4, 2e-4]), rest=torch.tensor([2e4, 2e4]))
        >>> chambers(torch.tensor([5e4, 0.0]))
        tensor([ 6., -4.])
        >>> chambers.pressure(torch.tensor([6.0, -4.0]))
        tensor([50000.,     0.])
    """

    area: Tensor
    growth: Tensor
    rest: Tensor
    least: Tensor | None
    most: Tensor | None

    def __init__(
        self,
        area: Tensor,
        growth: Tensor | None = None,
        rest: Tensor | None = None,
        least: Tensor | None = None,
        most: Tensor | None = None,
    ) -> None:
        super().__init__()
        check_positive("area", check_tensor("area", area, (None,)))
        growth, rest = (torch.zeros_like(area) if value is None else value for value in (growth, rest))
        given = {"growth": growth, "rest": rest, "least": least, "most": most}
        for name, value in given.items():
            if value is not None:
                check_finite(name, check_tensor(name, value, (area.shape[-1],)))
                check_same(**{"area": area, name: value})
        hold_rows(self, area=(area, 1), **{name: (value, 1) for name, value in given.items()})

    def _pushed(self, p: Tensor) -> Tensor:
        return self.area.to(p) * p * (1.0 + self.growth.to(p) * p)

    def forward(self, p: Tensor) -> Tensor:
        """Forces u (..., n_a), N, of pressures p (..., n_a), Pa: positive where a chamber pushes more than at rest."""
        check_tensor("p", p, (self.area.shape[-1],))
        return self._pushed(p) - self._pushed(self.rest.to(p))

    def pressure(self, u: Tensor) -> Tensor:
        """Pressures (..., n_a), Pa, that make forces u (..., n_a), N, within no limits."""
        check_tensor("u", u, (self.area.shape[-1],))
        ratio = (u + self._pushed(self.rest.to(u))) / self.area.to(u)
        # The root of growth p^2 + p = ratio that a chamber without growth has too; a pump does not reach the other.
        return 2.0 * ratio / (1.0 + torch.sqrt((1.0 + 4.0 * self.growth.to(u) * ratio).clamp(min=0.0)))

    def within(self, p: Tensor) -> Tensor:
        """p (..., n_a) cut to what may be commanded, Pa."""
        if self.least is not None:
            p = torch.maximum(p, self.least.to(p))
        return p if self.most is None else torch.minimum(p, self.most.to(p))
