"""The inverse kinematic controller: task velocity through a damped pseudo-inverse, elongation kept low beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.control.bounds import RateBounds, eased, solved_within
from apcc_torch.control.gain import check_gain, gain_matrix
from apcc_torch.linalg import damped_pseudo_inverse
from apcc_torch.model.coordinates import CONSTANT_CURVATURE, Coordinates
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import OURS, PAPER, Setting, Settings, aligned, resolved, setting
from apcc_torch.shapes import check_finite, check_same, check_tensor
from apcc_torch.spread import Numbers, spread


def elongation_cost(
    q: Tensor,
    epsilon: float = 0.0,
    coordinates: Coordinates = CONSTANT_CURVATURE,
    weights: Tensor | None = None,
) -> Tensor:
    """Psi (...) = ||dL||_2, m, of configurations (..., n). Eq. (50) [Dalenberg].

    Args:
        q: (..., n).
        epsilon: m. Psi = sqrt(|dL|^2 + eps^2) - eps has a gradient at dL = 0, where the printed norm has none.
        coordinates: What q is made of.
        weights: (..., n_b) of the sections' dL^2 in |dL|^2; None for 1, as printed.
    """
    dL = q[..., coordinates.elongations]
    squared = (dL.square() if weights is None else weights.to(dL) * dL.square()).sum(-1)
    return torch.sqrt(squared + epsilon**2) - epsilon  # Eq. (50)


def elongation_gradient(
    q: Tensor,
    epsilon: Setting,
    coordinates: Coordinates = CONSTANT_CURVATURE,
    weights: Tensor | None = None,
) -> Tensor:
    """Gradient of the smoothed `elongation_cost`, (..., n): W dL / sqrt(dL^T W dL + eps^2) on the elongations."""
    dL = q[..., coordinates.elongations]
    weighed = dL if weights is None else weights.to(dL) * dL
    slope = weighed / torch.sqrt((weighed * dL).sum(-1, keepdim=True) + aligned(epsilon, 1) ** 2)
    return coordinates.on_elongations(slope)


@dataclass(frozen=True, kw_only=True)
class InverseKinematicsSettings(Settings):
    """Settings of `InverseKinematics`."""

    K: Numbers = setting(1.0, "1/s", PAPER, "task gain: a number, one for x, y and z, or a matrix", rows="task")
    damping: Setting = setting(
        1e-3, "m/rad", OURS, "of the pseudo-inverse; 0 for the exact one", rows="number", least=0, key=False
    )
    null_gain: Setting = setting(
        0.2, "m/s", OURS, "weight of the elongation cost Psi in the null space", rows="number", least=0
    )
    epsilon: Setting = setting(5e-3, "m", OURS, "smoothing of Psi at zero elongation", rows="number", above=0)
    bend_rate: Setting | None = setting(
        None, "rad/s", OURS, "bound on the bends' rates; null: none", rows="number", above=0, key=False
    )
    length_rate: Setting | None = setting(
        None, "m/s", OURS, "bound on the elongations' rates; null: none", rows="number", above=0, key=False
    )
    null_weights: Numbers | None = setting(
        None, "", OURS, "how much each section's elongation counts in that Psi; null: alike", rows="sections", least=0
    )
    null_bends: Numbers | None = setting(
        None, "1/s", OURS, "how fast each section's bend grows where the tip leaves it free; null: 0", rows="sections"
    )
    null_step: Setting | None = setting(
        None,
        "",
        OURS,
        "largest share of the elongations that one period takes away; null: no bound",
        rows="number",
        above=0,
    )
    null_speed: Setting | None = setting(
        None,
        "m/s",
        OURS,
        "tip speed with which the null-space term rests; null: it never does",
        rows="number",
        above=0,
    )

    def check(self) -> None:
        """Raises where K is no positive gain."""
        check_gain("K", self.K)


class InverseKinematics(Part):
    """qdot = J^+ (xdot_d + K e) + (I - J^+ J) grad_Psi. Eqs. (14), (16), remark 2 [Dalenberg].

    Each number may also be a tensor (...), one a row. A row over a bound on its rates is scaled whole, which keeps the
    direction of its task velocity.

    grad_Psi is minus `null_gain` times the unit gradient of Psi, whose elongations `null_weights` weigh. With
    `null_bends` beta it has beta_i d_i on the bends d_i of section i too: as far as the tip leaves it free, a section
    with beta > 0 bends more and one with beta < 0 less.

    With `null_speed` grad_Psi acts while the tip is to move, by |v|^2 / (|v|^2 + null_speed^2) of v = xdot_d + K e, and
    rests with it. q_d is an integral: what a loaded arm does not follow adds up, for minutes, until the arm gives way
    and the tip is lost.

    With `null_step` the term is slowed for slow rates: near zero it decays at up to null_gain max(null_weights) /
    epsilon, and held over a period it overshoots where that times the period comes near 1, and feeds back noise.

    Args:
        *settings, **changes: See `InverseKinematicsSettings`.
        coordinates: What q is made of: the model's. Coordinates that are not driven get no velocity.
        n_sections: n_b, for weights and bends that are one number for all sections, or a profile.

    Raises:
        ConfigError: null_weights or null_bends has not one entry a section.
        ValueRangeError: K is not positive definite, or a setting is out of range.

    Example:
        >>> ik = InverseKinematics(K=2.0, null_gain=0.0)
        >>> J = torch.eye(3, 9, dtype=torch.float64)
        >>> e, still = torch.tensor([0.01, 0.0, 0.0]).double(), torch.zeros(3).double()
        >>> ik(J, e, still, torch.zeros(9).double())[:3]
        tensor([0.0200, 0.0000, 0.0000], dtype=torch.float64)
    """

    settings_type = InverseKinematicsSettings
    K: Tensor
    damping: Setting
    null_gain: Setting
    epsilon: Setting
    bend_rate: Setting | None
    length_rate: Setting | None
    null_weights: Tensor | None
    null_bends: Tensor | None
    null_step: Setting | None
    null_speed: Setting | None

    def __init__(
        self,
        *settings: Any,
        coordinates: Coordinates = CONSTANT_CURVATURE,
        n_sections: int | None = None,
        **changes: Any,
    ) -> None:
        super().__init__()
        s = resolved(InverseKinematicsSettings, settings, changes)
        self.coordinates = coordinates
        self.hold(s)
        hold_rows(self, K=(gain_matrix("K", s.K, 3), 2))
        for name, value in {"null_weights": s.null_weights, "null_bends": s.null_bends}.items():
            if value is not None:
                own = value.shape[-1] if isinstance(value, Tensor) and value.dim() else 1
                size = n_sections or (len(value) if isinstance(value, Sequence) else own)
                hold_rows(self, **{name: (check_finite(name, spread(name, value, size)), 1)})

    def forward(
        self,
        J_hat: Tensor,
        e: Tensor,
        xdot_d: Tensor,
        q: Tensor,
        dt: Tensor | None = None,
        bounds: RateBounds | None = None,
        beside: Tensor | None = None,
    ) -> Tensor:
        """Configuration velocity qdot (..., n), rad/s and m/s.

        Args:
            J_hat: (..., 3, n) tip Jacobian of the model.
            e: (..., 3) position error x_d - x, m.
            xdot_d: (..., 3) desired velocity, m/s.
            q: (..., n) configuration at which Psi is lowered.
            dt: (...) s for which the velocity is held, for `null_step`; None where it is not held.
            bounds: Of qdot; what would leave them drops out of the pseudo-inverse, see `solved_within`. None for none.
            beside: (..., n) velocity to follow beside grad_Psi as far as the tip leaves it free; None for none.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """
        check_tensor("J_hat", J_hat, (3, None))
        check_tensor("e", e, (3,))
        check_tensor("xdot_d", xdot_d, (3,))
        check_tensor("q", q, (J_hat.shape[-1],))
        check_same(J_hat=J_hat, e=e, xdot_d=xdot_d, q=q)
        J_hat = self.coordinates.driven(J_hat)
        velocity = self.tip_velocity(e, xdot_d)
        descent = self.descent(q, dt, velocity)
        descent = (descent if beside is None else descent + beside).unsqueeze(-1)

        def solve(fixed: Tensor | None, free: Tensor | None) -> Tensor:
            if fixed is None or free is None:
                return self._solved(J_hat, velocity.unsqueeze(-1), descent, bounds)
            asked = velocity.unsqueeze(-1) - J_hat @ fixed.unsqueeze(-1)
            return self._solved(J_hat * free.unsqueeze(-2), asked, descent * free.unsqueeze(-1), bounds)

        return self.bounded(solve(None, None) if bounds is None else solved_within(solve, bounds))

    def _solved(self, J: Tensor, velocity: Tensor, descent: Tensor, bounds: RateBounds | None) -> Tensor:
        """Eq. (16), with J^+ (v - J descent) + descent for J^+ v + (I - J^+ J) descent: one product fewer."""
        asked = velocity - J @ descent
        J_pinv = damped_pseudo_inverse(J, eased(aligned(self.damping, 2), asked, bounds))
        return (J_pinv @ asked + descent).squeeze(-1)

    def tip_velocity(self, e: Tensor, xdot_d: Tensor) -> Tensor:
        """xdot_d + K e (..., 3), m/s: what is asked of the tip. Arguments as `forward`."""
        return xdot_d + (self.K.to(dtype=e.dtype, device=e.device) @ e.unsqueeze(-1)).squeeze(-1)

    def descent(self, q: Tensor, dt: Tensor | None = None, velocity: Tensor | None = None) -> Tensor:
        """grad_Psi (..., n) of Eq. (16) at q (..., n): minus the null gain times the gradient of the smoothed Psi.

        With `null_bends`, their growth too. With `null_step` and dt (...) s, as slow as that asks for; with
        `null_speed` and the tip's `velocity` (..., 3) m/s, as far as that lets it.
        """
        for name, each in {"null_weights": self.null_weights, "null_bends": self.null_bends}.items():
            if each is not None:
                check_tensor(name, each, (q[..., self.coordinates.elongations].shape[-1],))
        slope = elongation_gradient(q, self.epsilon, self.coordinates, self.null_weights)
        down = aligned(-self.null_gain, 1) * slope
        if self.null_bends is not None:
            down = down + self.coordinates.on_bends(self.null_bends.to(q)) * q
        if self.null_speed is not None and velocity is not None:
            squared = (velocity * velocity).sum(-1, keepdim=True)
            down = down * squared / (squared + aligned(self.null_speed, 1) ** 2)
        if self.null_step is None or dt is None:
            return down
        heaviest = 1.0 if self.null_weights is None else self.null_weights.to(q).amax(-1)
        fastest = self.null_gain * heaviest / self.epsilon * dt
        return down * (self.null_step / fastest.clamp(min=1e-12)).clamp(max=1.0).unsqueeze(-1)

    def bounded(self, qdot: Tensor) -> Tensor:
        """qdot (..., n), each row over a bound scaled whole."""
        if self.bend_rate is None and self.length_rate is None:
            return qdot
        peak = self.coordinates.of_pattern(qdot).abs().amax(-2)
        excess = torch.ones_like(peak[..., 0])
        if self.bend_rate is not None:
            excess = torch.maximum(excess, peak[..., self.coordinates.angular].amax(-1) / self.bend_rate)
        if self.length_rate is not None:
            excess = torch.maximum(excess, peak[..., self.coordinates.linear].amax(-1) / self.length_rate)
        return qdot / excess.unsqueeze(-1)
