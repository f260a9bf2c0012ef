"""The inverse kinematic controller: task velocity through a damped pseudo-inverse, elongation kept low beside it."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.control.gain import gain_matrix
from apcc_torch.linalg import damped_pseudo_inverse
from apcc_torch.model.coordinates import CONSTANT_CURVATURE, Coordinates
from apcc_torch.part import Part, check_settings, check_settings_or_zero, hold, hold_rows
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.shapes import check_finite, check_same, check_tensor


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


class InverseKinematics(Part):
    """qdot = J^+ (xdot_d + K e) + (I - J^+ J) grad_Psi. Eqs. (14), (16), remark 2 [Dalenberg].

    Each number may also be a tensor (...), one a row.

    Args:
        K: Task gain, 1/s: a number, a (3,) diagonal or (..., 3, 3).
        damping: Damping of the pseudo-inverse, m per rad: J^T (J J^T + damping^2 I)^-1. 0 for the exact one.
        null_gain: Weight of the null-space term, m/s: grad_Psi is minus this times the unit gradient of Psi.
        epsilon: Smoothing of Psi at dL = 0, m.
        bend_rate: Bound on every angle's rate, rad/s; None for no bound. A row over a bound is scaled whole, which
            keeps the direction of its task velocity.
        length_rate: Bound on every length's rate, m/s; None for no bound.
        coordinates: What q is made of: the model's. Coordinates that are not driven get no velocity.
        null_weights: (..., n_b) weights of the sections' elongations in the Psi that is lowered; None for 1, Eq. (50).
        null_bends: (..., n_b) beta, 1/s: grad_Psi has beta_i d_i on the bends d_i of section i too. As far as the tip
            leaves it free, a section with beta > 0 bends more and one with beta < 0 less; None for 0, Eq. (50).
        null_speed: m/s. grad_Psi acts while the tip is to move, by |v|^2 / (|v|^2 + null_speed^2) of v = xdot_d + K e,
            and rests with it. q_d is an integral: what a loaded arm does not follow adds up, for minutes, until the arm
            gives way and the tip is lost. None for a term that lasts, Eq. (16).
        null_step: Largest share of the elongations that one period takes away; None for no bound. Near zero the term
            decays at up to null_gain max(null_weights) / epsilon, and held over a period it overshoots where that
            times the period comes near 1: a slow rate then feeds back the sensors' noise. The term is scaled whole.

    Raises:
        ShapeError: null_weights or null_bends has not one entry a section.
        ValueRangeError: K is not positive definite, or a setting is negative (beta may be) or not finite.
    """

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
        K: float | Tensor = 1.0,
        damping: Setting = 1e-3,
        null_gain: Setting = 0.05,
        epsilon: Setting = 5e-3,
        bend_rate: Setting | None = None,
        length_rate: Setting | None = None,
        coordinates: Coordinates = CONSTANT_CURVATURE,
        null_weights: Tensor | None = None,
        null_bends: Tensor | None = None,
        null_step: Setting | None = None,
        null_speed: Setting | None = None,
    ) -> None:
        super().__init__()
        self.coordinates = coordinates
        if null_weights is not None:
            check_setting("null_weights", check_tensor("null_weights", null_weights, (None,)), zero=True)
        if null_bends is not None:
            check_finite("null_bends", check_tensor("null_bends", null_bends, (None,)))
        K = gain_matrix("K", K, 3)
        hold_rows(self, K=(K, 2), null_weights=(null_weights, 1), null_bends=(null_bends, 1))
        weights = {"damping": damping, "null_gain": null_gain}
        scales = {"epsilon": epsilon, "null_step": null_step, "null_speed": null_speed}
        bounds = {"bend_rate": bend_rate, "length_rate": length_rate}
        check_settings_or_zero(**weights)
        check_settings(**scales, **bounds)
        hold(self, **weights, **scales, **bounds)

    def forward(self, J_hat: Tensor, e: Tensor, xdot_d: Tensor, q: Tensor, dt: Tensor | None = None) -> Tensor:
        """Configuration velocity qdot (..., n), rad/s and m/s.

        Args:
            J_hat: (..., 3, n) tip Jacobian of the model.
            e: (..., 3) position error x_d - x, m.
            xdot_d: (..., 3) desired velocity, m/s.
            q: (..., n) configuration at which Psi is lowered.
            dt: (...) s for which the velocity is held, for `null_step`; None where it is not held.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """
        check_tensor("J_hat", J_hat, (3, None))
        check_tensor("e", e, (3,))
        check_tensor("xdot_d", xdot_d, (3,))
        check_tensor("q", q, (J_hat.shape[-1],))
        check_same(J_hat=J_hat, e=e, xdot_d=xdot_d, q=q)
        J_hat = self.coordinates.driven(J_hat)
        J_pinv = damped_pseudo_inverse(J_hat, aligned(self.damping, 2))
        velocity = self.tip_velocity(e, xdot_d)
        descent = self.descent(q, dt, velocity).unsqueeze(-1)
        # Eq. (16), with J^+ (v - J descent) + descent for J^+ v + (I - J^+ J) descent: one product fewer.
        qdot = (J_pinv @ (velocity.unsqueeze(-1) - J_hat @ descent) + descent).squeeze(-1)
        return self.bounded(qdot)

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
