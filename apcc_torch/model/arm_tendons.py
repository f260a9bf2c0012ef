"""An arm's tendons told one by one, and what drives them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.settings import OURS, TURN, Settings, setting
from apcc_torch.spread import Numbers, spread


@dataclass(frozen=True, kw_only=True)
class Tendons(Settings):
    """Where each tendon runs, as far as tendons are not spaced evenly on racks."""

    angles: tuple[float, ...] | None = setting(
        None,
        "rad",
        OURS,
        "of each around the backbone, from the section's x axis; null: as on the racks",
        least=-TURN,
        most=TURN,
    )
    offsets: Numbers | None = setting(
        None, "m", OURS, "distance of each from the backbone; null: tendon_offset", above=0, most=30
    )
    ends: tuple[int, ...] | None = setting(
        None, "", OURS, "section at whose tip each ends, from 1; null: as on the racks", least=1
    )

    def check_on(self, n_sections: int, n_racked: int) -> None:
        """Raises ConfigError where the entries do not fit each other, or an arm with so many tendons on its racks."""
        n_a = self.count(n_racked)
        if not n_a:
            raise ConfigError("tendons.angles must name at least one tendon")
        if n_a != n_racked and (self.angles is None or self.ends is None):
            lacking = "angles" if self.angles is None else "ends"
            raise ConfigError(f"tendons.{lacking} must have {n_a} entries, as the racks have only {n_racked} tendons")
        if self.ends is not None and len(self.ends) != n_a:
            raise ConfigError(f"tendons.ends must have {n_a} entries, one a tendon, got {len(self.ends)}")
        if self.ends is not None and max(self.ends) > n_sections:
            raise ConfigError(f"tendons.ends must be sections from 1 to {n_sections}, got {list(self.ends)}")
        if self.offsets is not None:
            spread("tendons.offsets", self.offsets, n_a)

    def count(self, n_racked: int) -> int:
        """Number of tendons n_a of an arm with so many on its racks."""
        told = self.ends if self.angles is None else self.angles
        return n_racked if told is None else len(told)

    def routing(self, racked: TendonRouting, tips: Tensor) -> TendonRouting:
        """The tendons.

        Args:
            racked: As they would run on the racks.
            tips: (..., n_b) abscissae of the sections' ends, m.
        """
        if self.angles is self.offsets is self.ends is None:
            return racked
        angles = (
            racked.angles if self.angles is None else torch.tensor(self.angles, dtype=tips.dtype, device=tips.device)
        )
        anchors = racked.anchors if self.ends is None else tips[..., [end - 1 for end in self.ends]]
        offsets = self.offsets
        if offsets is None:
            offsets = racked.offsets[..., :1].expand(*racked.offsets.shape[:-1], len(angles))
        return TendonRouting(angles, spread("tendons.offsets", offsets, len(angles)).to(tips), anchors, racked.layout)


@dataclass(frozen=True, kw_only=True)
class Actuation(Settings):
    """What drives the tendons, in the unit of a recording's inputs; a number for all tendons, or one each."""

    sets: str = setting(
        "length",
        "",
        OURS,
        "what an input sets: length, that its motor takes in of an elastic tendon; tension, its force at the motor",
        choices=("length", "tension"),
    )
    inputs: tuple[int, ...] | None = setting(
        None, "", OURS, "input that drives each tendon, from 0; null: each has its own", least=0
    )
    pulls: Numbers = setting(
        1.0,
        "",
        OURS,
        "what a tendon is pulled by per unit of its input, m, or N of tension; negative where a growing input pays out",
    )
    stiffness: Numbers = setting(3000.0, "N/m", OURS, "of a tendon between its motor and its end", above=0)
    pre_stretch: Numbers = setting(0.0, "m", OURS, "stretch of a tendon where inputs are zero; negative: it is slack")
    friction: float = setting(0.0, "", OURS, "capstan coefficient, tension lost per radian of bend", least=0)

    def check_on(self, n_tendons: int) -> None:
        """Raises ConfigError where the entries do not fit an arm with so many tendons."""
        if self.inputs is not None and len(self.inputs) != n_tendons:
            raise ConfigError(f"actuation.inputs must have {n_tendons} entries, one a tendon, got {len(self.inputs)}")
        for name in ("pulls", "stiffness", "pre_stretch"):
            spread(f"actuation.{name}", getattr(self, name), n_tendons)

    def pulled(self, inputs: Tensor, n_tendons: int) -> Tensor:
        """Length that each tendon's motor has taken in (..., n_a), m, with the stretch at the start.

        Args:
            inputs: (..., m) in the unit that `pulls` is for.
            n_tendons: Number n_a.

        Raises:
            ConfigError: The inputs set tensions.
        """
        if self.sets != "length":
            raise ConfigError("the inputs of this arm set tensions, not lengths: actuation.sets is tension")
        pulls, begun = (spread(name, getattr(self, name), n_tendons).to(inputs) for name in ("pulls", "pre_stretch"))
        return inputs[..., list(self.driving(n_tendons))] * pulls + begun

    def driving(self, n_tendons: int) -> tuple[int, ...]:
        """The input that drives each tendon, from 0."""
        return tuple(range(n_tendons)) if self.inputs is None else self.inputs
