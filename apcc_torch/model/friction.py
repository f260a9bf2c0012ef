"""What happens to a tendon's force between the motor and the arm: slack and friction. Plant side only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part
from apcc_torch.settings import OURS, Settings, resolved, setting
from apcc_torch.shapes import check_same, check_tensor


def taut(u: Tensor, smoothing: float = 0.0) -> Tensor:
    """Keeps only what a tendon can do, pull: u = -relu(-u); tension is -u.

    Args:
        u: (..., n_a) commanded forces conjugate to tendon length, N.
        smoothing: Width of the rounded corner, N. Zero is the exact corner; a positive width is smooth to every order.
    """
    if smoothing == 0.0:
        return -torch.relu(-u)
    return -0.5 * (torch.sqrt(u * u + smoothing * smoothing) - u)


CORNER = 1e-5
"""Width of the rounding where an elastic tendon goes slack, m: a tenth of what is read off a servo."""


def elastic_tension(stretch: Tensor, stiffness: Tensor) -> Tensor:
    """Tension (..., n_a) of elastic tendons that can go slack, N: stiffness times what they are stretched by, or none.

    Args:
        stretch: (..., n_a) m; negative: slack.
        stiffness: (..., n_a) N/m.

    Example:
        >>> elastic_tension(torch.tensor([0.002, -0.001]), torch.tensor([3000.0, 3000.0]))
        tensor([6.0000e+00, 7.4506e-05])
    """
    return -stiffness * taut(-stretch, CORNER)


@dataclass(frozen=True, kw_only=True)
class TendonTransmissionSettings(Settings):
    """Settings of `TendonTransmission`."""

    friction: float = setting(0.0, "", OURS, "capstan coefficient of dry friction along each tendon", least=0)
    slack: bool = setting(True, "", OURS, "true: tendons only pull; commands must then keep them taut")
    smoothing: float = setting(0.0, "N", OURS, "rounding of the slack corner", least=0, key=False)
    sliding_speed: float = setting(1e-3, "m/s", OURS, "tendon speed at which friction is developed", above=0, key=False)


class TendonTransmission(Part):
    """Generalized force of tendons that can go slack and rub along their way (capstan friction).

    A tendon that slides towards the motor loses tension with the angle it has been bent through,
    T(X) = T(0) exp(-mu phi(X)); one that is dragged out gains by the same factor; one at rest keeps its tension.

    Args:
        routing: Where the tendons run.
        *settings, **changes: See `TendonTransmissionSettings`; no friction and no slack leave tau = B u.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> routing = rack_routing(torch.tensor([0.2]))
        >>> pulling = TendonTransmission(routing, friction=0.1)
        >>> still = torch.zeros(3)
        >>> pulling(torch.tensor([-1.0, 2.0, 0.0]), still, still, torch.tensor([0.2]))
        tensor([ 0.0270,  0.0000, -1.0000])
    """

    settings_type = TendonTransmissionSettings
    friction: float
    slack: bool
    smoothing: float
    sliding_speed: float

    def __init__(self, routing: TendonRouting, *settings: Any, **changes: Any) -> None:
        super().__init__()
        self.routing = routing
        self.hold(resolved(TendonTransmissionSettings, settings, changes))

    def forward(self, u: Tensor, q: Tensor, qdot: Tensor, lengths: Tensor, matrix: Tensor | None = None) -> Tensor:
        """Generalized force tau (..., n), N m of angles and N of lengths.

        Args:
            u: (..., n_a) motor-side forces conjugate to tendon length, N; tension is -u.
            q: (..., n), of which each section's first two are its bends, rad.
            qdot: (..., n) its rates.
            lengths: (..., n_b) section rest lengths of the plant, m.
            matrix: (..., n, n_a) the model's B; None for that of constant-curvature sections, n = 3 n_b.
        """
        n_b = lengths.shape[-1]
        if matrix is None:
            matrix = self.routing.matrix(lengths)
        n = matrix.shape[-2]
        check_tensor("u", u, (self.routing.n_tendons,))
        check_tensor("q", q, (n,))
        check_tensor("qdot", qdot, (n,))
        check_same(u=u, q=q, qdot=qdot, lengths=lengths)
        if self.slack:
            u = taut(u, self.smoothing)
        if self.friction == 0.0:
            return (matrix @ u.unsqueeze(-1)).squeeze(-1)
        speed = (matrix.mT @ qdot.unsqueeze(-1)).squeeze(-1)
        # +1 while the tendon is pulled in, -1 while it is dragged out.
        direction = torch.tanh(-speed / self.sliding_speed)
        share = self.tension_share(q, lengths, direction)
        rows = matrix.unflatten(-2, (n_b, n // n_b)) * share.unsqueeze(-2)
        return (rows.flatten(-3, -2) @ u.unsqueeze(-1)).squeeze(-1)

    def tension_share(self, q: Tensor, lengths: Tensor, direction: Tensor) -> Tensor:
        """Mean tension in each section over the tension at the motor (..., n_b, n_a).

        Args:
            q: (..., n), of which each section's first two are its bends, rad.
            lengths: (..., n_b) section rest lengths, m.
            direction: (..., n_a) +1 pulled in, -1 dragged out, between: not fully sliding.
        """
        return tension_share(self.routing.fractions(lengths), q, self.friction * direction)


def tension_share(fractions: Tensor, q: Tensor, rate: Tensor) -> Tensor:
    """Mean tension in each section over the tension at the motor (..., n_b, n_a) under capstan friction.

    Args:
        fractions: (..., n_b, n_a) share of each section that each tendon traverses.
        q: (..., n), of which each section's first two are its bends, rad.
        rate: (..., n_a) relative loss of tension per radian on the way from the motor, mu times the direction of
            sliding: positive pulled in, negative dragged out.
    """
    bend = q.unflatten(-1, (fractions.shape[-2], -1))[..., :2]
    # The square root is rounded off within a microradian, so that the straight pose has a derivative.
    angle = torch.sqrt((bend * bend).sum(-1) + 1e-12) - 1e-6
    turned = fractions * angle.unsqueeze(-1)
    before = torch.cumsum(turned, dim=-2) - turned
    rate = rate.unsqueeze(-2)
    exponent = rate * turned
    # The mean of exp(-e s) over s in [0, 1]: (1 - exp(-e)) / e, by its series near e = 0.
    small = exponent.abs() < 1e-3
    safe = torch.where(small, 1.0, exponent)
    series = 1.0 - exponent * (0.5 - exponent * (1.0 / 6.0 - exponent / 24.0))
    mean = torch.where(small, series, -torch.expm1(-safe) / safe)
    return torch.exp(-rate * before) * mean
