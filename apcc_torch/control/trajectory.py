"""What the end effector is asked to do: the sine of Eq. (51), a set-point."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from apcc_torch.control.step_io import Target
from apcc_torch.part import Part, hold_numbers, hold_rows
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.shapes import broadcast, check_finite, check_tensor


class Trajectory(Protocol):
    """Desired position and velocity at a time."""

    def __call__(self, time: Tensor) -> Target: ...


class SineTrajectory(Part):
    """r(t) = r_0 + A sin(omega t). Eq. (51) [Dalenberg].

    Args:
        r_0: (..., 3) centre, world frame, m.
        A: (..., 3) amplitude, m.
        omega: Angular frequency, rad/s, a number or (...) one a row.

    Raises:
        ValueRangeError: omega is not positive, or r_0 or A is not finite.
    """

    r_0: Tensor
    A: Tensor
    omega: Setting

    def __init__(self, r_0: Tensor, A: Tensor, omega: Setting) -> None:
        super().__init__()
        check_setting("omega", omega)
        centre, amplitude = (check_finite(n, check_tensor(n, v, (3,))) for n, v in {"r_0": r_0, "A": A}.items())
        hold_rows(self, r_0=(centre, 1), A=(amplitude, 1))
        hold_numbers(self, omega=omega)

    def forward(self, time: Tensor) -> Target:
        """Target at time (...), s."""
        phase = (self.omega * time).unsqueeze(-1)
        r_0, A = self.r_0.to(time), self.A.to(time)
        x_d = r_0 + A * torch.sin(phase)  # Eq. (51)
        return Target(x_d, aligned(self.omega, 1) * A * torch.cos(phase))


class SetPoint(Part):
    """A constant desired position.

    Args:
        x_d: (..., 3) world frame, m.

    Raises:
        ValueRangeError: x_d is not finite.
    """

    x_d: Tensor

    def __init__(self, x_d: Tensor) -> None:
        super().__init__()
        hold_rows(self, x_d=(check_finite("x_d", check_tensor("x_d", x_d, (3,))), 1))

    def forward(self, time: Tensor) -> Target:
        """Target at time (...), s."""
        x_d = self.x_d.to(time).expand(*broadcast(self.x_d.shape[:-1], time.shape), 3)
        return Target(x_d, torch.zeros_like(x_d))
