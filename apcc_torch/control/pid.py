"""The PID loop on tendon length changes, section V-B."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.errors import ValueRangeError
from apcc_torch.shapes import check_same, check_tensor


class TendonPID(nn.Module):
    """u = K_P (y_d - y) + K_I z + K_D (ydot_d - ydot) with zdot = y_d - y. Section V-B [Dalenberg].

    y is a tendon's length change and u the force conjugate to it, so tension is -u.

    Args:
        K_P: N/m.
        K_I: N/(m s).
        K_D: N s/m.
        force_limit: Bound on |u|, N; None for no bound.
        integral_limit: Bound on |z|, m s; None for no bound.

    Raises:
        ValueRangeError: A gain is negative, or a bound is not positive.
    """

    def __init__(
        self,
        K_P: float = 750.0,
        K_I: float = 1.0,
        K_D: float = 5.0,
        force_limit: float | None = None,
        integral_limit: float | None = None,
    ) -> None:
        super().__init__()
        for name, gain in {"K_P": K_P, "K_I": K_I, "K_D": K_D}.items():
            if not 0 <= gain < float("inf"):
                raise ValueRangeError(f"{name} must be zero or positive and finite, got {gain}")
        for name, bound in {"force_limit": force_limit, "integral_limit": integral_limit}.items():
            if bound is not None and not 0 < bound < float("inf"):
                raise ValueRangeError(f"{name} must be positive and finite, got {bound}")
        self.K_P = K_P
        self.K_I = K_I
        self.K_D = K_D
        self.force_limit = force_limit
        self.integral_limit = integral_limit

    def forward(self, z: Tensor, y: Tensor, ydot: Tensor, y_d: Tensor, ydot_d: Tensor) -> Tensor:
        """Forces u (..., n_a), N.

        Args:
            z: (..., n_a) integral of the error, m s, from `integrate`; zero at first.
            y: (..., n_a) tendon length changes, m.
            ydot: (..., n_a) m/s.
            y_d: (..., n_a) their reference, m.
            ydot_d: (..., n_a) m/s.
        """
        check_tensor("y", y, (None,))
        check_tensor("y_d", y_d, (y.shape[-1],))
        check_same(y=y, y_d=y_d)
        u = self.K_P * (y_d - y) + self.K_I * z + self.K_D * (ydot_d - ydot)
        return u if self.force_limit is None else u.clamp(-self.force_limit, self.force_limit)

    def integrate(self, z: Tensor, y: Tensor, y_d: Tensor, dt: float) -> Tensor:
        """The integral after dt seconds, (..., n_a) m s."""
        z = z + dt * (y_d - y)
        return z if self.integral_limit is None else z.clamp(-self.integral_limit, self.integral_limit)


class TendonReference(NamedTuple):
    """Reference of the tendon loop: y_d (..., n_a) m and ydot_d (..., n_a) m/s."""

    y_d: Tensor
    ydot_d: Tensor


def ramp(previous: Tensor, y: Tensor, share: float, period: float) -> TendonReference:
    """The reference between two commands: a straight line over one control period.

    Args:
        previous: (..., n_a) last command, m.
        y: (..., n_a) this command, m.
        share: Part of the period that has passed, 0 to 1.
        period: Control period, s.
    """
    return TendonReference(torch.lerp(previous, y, share), (y - previous) / period)
