"""Proportional valves: the pressure in a chamber follows its command with a lag."""

from __future__ import annotations

from math import exp
from typing import Self

from torch import Tensor

from apcc_torch.control.pid import TendonReference
from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm
from apcc_torch.model.chambers import ChamberForce
from apcc_torch.part import Part
from apcc_torch.settings import check_setting


class Valves(Part):
    """The chambers of a true arm with their valves: p_dot = (p_d - p) / time, and no command leaves its limits.

    Args:
        chambers: What their pressure does.
        time: s; 0: the pressure is what was commanded.

    Raises:
        ValueRangeError: The time is negative.

    Example:
        >>> arm = Arm(lengths=[0.145], chambers=Chambers(areas=2e-4))
        >>> valves = Valves.of(arm)
        >>> valves.after(valves.at_rest, torch.tensor([1e4, 0.0, 2e5]).double(), 0.05).round()
        tensor([ 6321.,     0., 63212.], dtype=torch.float64)
    """

    time: float

    def __init__(self, chambers: ChamberForce, time: float = 0.05) -> None:
        super().__init__()
        self.chambers = chambers
        self.time = check_setting("time", time, zero=True)

    @classmethod
    def of(cls, arm: Arm) -> Self:
        """Those of an arm.

        Raises:
            ConfigError: It has no chambers.
        """
        if arm.chambers is None:
            raise ConfigError("valves are of chambers, and the arm has none: arm.chambers is null")
        return cls(arm.chambers.force(arm.n_sections), arm.chambers.valve_time)

    @property
    def at_rest(self) -> Tensor:
        """(..., n_a) Pa, the pressures at rest."""
        return self.chambers.rest

    def after(self, p: Tensor, commanded: Tensor, dt: float) -> Tensor:
        """Pressures (..., n_a), Pa, dt seconds after they were p, with one command (..., n_a) all the while."""
        goal = self.chambers.within(commanded)
        if self.time == 0.0:
            return goal
        return goal + exp(-dt / self.time) * (p - goal)

    def transmitted(self, p: Tensor, reference: TendonReference, dt: float) -> TendonReference:
        """What reaches the arm, dt seconds later, of what valves at pressures p (..., n_a), Pa, are told."""
        goal = p if reference.pressure is None else reference.pressure
        p = self.after(p, goal, dt)
        return reference._replace(force=self.forces(p), pressure=p)

    def forces(self, p: Tensor) -> Tensor:
        """Forces u (..., n_a), N, of pressures p (..., n_a), Pa."""
        forces: Tensor = self.chambers(p)
        return forces
