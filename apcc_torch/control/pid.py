"""The PID loop on tendon length changes, section V-B."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.bounds import within
from apcc_torch.part import Part
from apcc_torch.settings import OURS, PAPER, Setting, Settings, aligned, resolved, setting
from apcc_torch.shapes import check_same, check_tensor


@dataclass(frozen=True, kw_only=True)
class TendonPIDSettings(Settings):
    """Settings of `TendonPID`."""

    K_P: Setting = setting(750.0, "N/m", PAPER, "proportional gain", rows="number", least=0)
    K_I: Setting = setting(1.0, "N/(m s)", PAPER, "integral gain", rows="number", least=0)
    K_D: Setting = setting(5.0, "N s/m", PAPER, "derivative gain", rows="number", least=0)
    force_limit: Setting | None = setting(
        None, "N", OURS, "bound on each tendon's force; null: none", rows="number", above=0
    )
    integral_limit: Setting | None = setting(
        None, "m s", OURS, "bound on the integral of the error; null: none", rows="number", above=0, key=False
    )


class TendonPID(Part):
    """u = K_P (y_d - y) + K_I z + K_D (ydot_d - ydot) with zdot = y_d - y. Section V-B [Dalenberg].

    y is a tendon's length change and u the force conjugate to it, so tension is -u. Each number may also be a
    tensor (...), one a row.

    Args:
        *settings, **changes: See `TendonPIDSettings`.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> y = torch.tensor([0.001, 0.0])
        >>> TendonPID(K_I=0.0, K_D=0.0)(0 * y, 0 * y, 0 * y, y, 0 * y)
        tensor([0.7500, 0.0000])
    """

    settings_type = TendonPIDSettings
    K_P: Setting
    K_I: Setting
    K_D: Setting
    force_limit: Setting | None
    integral_limit: Setting | None

    def __init__(self, *settings: Any, **changes: Any) -> None:
        super().__init__()
        self.hold(resolved(TendonPIDSettings, settings, changes))

    def forward(
        self, z: Tensor, y: Tensor, ydot: Tensor, y_d: Tensor, ydot_d: Tensor, force: Tensor | None = None
    ) -> Tensor:
        """Forces u (..., n_a), N.

        Args:
            z: (..., n_a) integral of the error, m s, from `integrate`; zero at first.
            y: (..., n_a) tendon length changes, m.
            ydot: (..., n_a) m/s.
            y_d: (..., n_a) their reference, m.
            ydot_d: (..., n_a) m/s.
            force: (..., n_a) feed-forward, N, added before the bound; None for none.
        """
        check_tensor("y", y, (None,))
        check_tensor("y_d", y_d, (y.shape[-1],))
        check_same(y=y, y_d=y_d)
        K_P, K_I, K_D = aligned(self.K_P, 1), aligned(self.K_I, 1), aligned(self.K_D, 1)
        u = K_P * (y_d - y) + K_I * z + K_D * (ydot_d - ydot)
        return within(u if force is None else u + force, self.force_limit)

    def integrate(self, z: Tensor, y: Tensor, y_d: Tensor, dt: float | Tensor) -> Tensor:
        """The integral after dt seconds, (..., n_a) m s."""
        z = z + dt * (y_d - y)
        return within(z, self.integral_limit)


class TendonReference(NamedTuple):
    """What tendons or chambers are told.

    y_d: (..., n_a) m, ydot_d: (..., n_a) m/s and force, a feed-forward (..., n_a) N: the reference of the tendon loop.
    pressure: (..., n_a) Pa commanded, of chambers, which have no such loop; None of tendons.
    """

    y_d: Tensor
    ydot_d: Tensor
    force: Tensor | None = None
    pressure: Tensor | None = None


def ramp(
    previous: Tensor,
    y: Tensor,
    share: float,
    period: float,
    force: Tensor | None = None,
    pressure: Tensor | None = None,
) -> TendonReference:
    """The reference between two commands: a straight line over one control period.

    Args:
        previous: (..., n_a) last command, m.
        y: (..., n_a) this command, m.
        share: Part of the period that has passed, 0 to 1.
        period: Control period, s.
        force: (..., n_a) feed-forward during the period, N; None for none.
        pressure: (..., n_a) commanded during the period, Pa; None of tendons.
    """
    return TendonReference(torch.lerp(previous, y, share), (y - previous) / period, force, pressure)
