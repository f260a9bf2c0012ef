"""External forces in motion without accelerations: the generalized-momentum observer [De Luca et al., 2006].

With p = M(q) qdot the equation of motion reads

    pdot = B u + C^T qdot - G - K q - D qdot + tau_ext,

and r = gain (p - p(0) - integral of (all but tau_ext, plus r)) follows tau_ext as a filter of first order does, in
every coordinate by itself and with the time constant 1 / gain.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.estimation.weighted_estimate import WeightedEstimate, weighted_estimate
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part, hold_numbers
from apcc_torch.settings import Setting, aligned, check_setting
from apcc_torch.shapes import check_same, check_tensor


class ObserverState(NamedTuple):
    """What the observer remembers.

    integral: (..., n) of the known forces and of r, less the first momentum.
    r: (..., n) estimate of the external generalized force, N m and N.
    started: (...) bool, whether a first sample has set the momentum.
    """

    integral: Tensor
    r: Tensor
    started: Tensor


class MomentumObserver(Part):
    """Follows the external generalized force of an arm in motion.

    Args:
        dynamics: The model, of constant rest lengths.
        routing: Its tendons.
        gain: 1/s; a contact is seen after about 1 / gain s. Explicit steps of dt are stable below gain dt = 2.
        tendon_damping: Viscous friction of each tendon in its guides, N s/m.
        limit: Largest standard deviation of a force component that counts as determined, N.

    Raises:
        ValueRangeError: A number is out of range.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25], mass=0.4)
        >>> dynamics, still = arm.dynamics(), torch.zeros(6).double()
        >>> q = equilibrium(dynamics, payload=torch.tensor(0.1).double()).q
        >>> observer = MomentumObserver(dynamics, arm.routing())
        >>> state = observer.initial_state(q)
        >>> for _ in range(30):
        ...     state = observer(state, q, still, still, 0.05)
        >>> observer.load(state, q, 1e-4 * torch.eye(6).double()).value
        tensor([0.1000], dtype=torch.float64)
    """

    gain: Setting
    tendon_damping: Setting

    def __init__(
        self,
        dynamics: SoftArmDynamics,
        routing: TendonRouting,
        gain: Setting = 10.0,
        tendon_damping: Setting = 0.0,
        limit: float = 5.0,
    ) -> None:
        super().__init__()
        hold_numbers(
            self,
            gain=check_setting("gain", gain),
            tendon_damping=check_setting("tendon_damping", tendon_damping, zero=True),
        )
        self.limit = check_setting("limit", limit)
        self.dynamics = dynamics
        self.routing = routing
        self.backbone = PCCBackbone(dynamics.n_sections, dynamics.base_rotation)

    def initial_state(self, q: Tensor) -> ObserverState:
        """Before the first sample; q (..., n) is read for its shape alone."""
        zero = torch.zeros_like(q)
        return ObserverState(zero, zero, torch.zeros_like(q[..., 0], dtype=torch.bool))

    def forward(self, state: ObserverState, q: Tensor, qdot: Tensor, u: Tensor, dt: Tensor | float) -> ObserverState:
        """The observer after one more sample.

        Args:
            state: From `initial_state` or the last sample.
            q: (..., n) configuration, and qdot (..., n) its velocity.
            u: (..., n_a) forces conjugate to tendon length, N; tension is -u.
            dt: Time since the last sample, s.
        """
        d = self.dynamics
        check_tensor("u", u, (self.routing.n_tendons,))
        check_same(q=q, qdot=qdot, u=u)
        B = self.routing.matrix(d.lengths)
        pull = u - aligned(self.tendon_damping, 1) * (B.mT @ qdot.unsqueeze(-1)).squeeze(-1)
        known = (B @ pull.unsqueeze(-1)).squeeze(-1) - d.gravity(q)
        known = known - d.stiffness_diagonal * q - d.damping_diagonal * qdot
        known = known + (d.coriolis(q, qdot).mT @ qdot.unsqueeze(-1)).squeeze(-1)
        momentum = (d.inertia(q) @ qdot.unsqueeze(-1)).squeeze(-1)
        started = state.started.unsqueeze(-1)
        # The first sample sets the momentum to start from.
        integral = torch.where(started, state.integral + dt * (known + state.r), momentum)
        r = aligned(self.gain, 1) * (momentum - integral)
        return ObserverState(integral, r, torch.ones_like(state.started))

    def load(self, state: ObserverState, q: Tensor, covariance: Tensor, payload: bool = True) -> WeightedEstimate:
        """Payload (..., 1) kg, or else tip force (..., 3) N, that explains r best.

        Args:
            state: The observer.
            q: (..., n) configuration.
            covariance: (..., n, n) of r, as it is on an unloaded arm in motion.
            payload: Which of the two.
        """
        J = self.backbone.tip_jacobian(q, self.dynamics.lengths)
        if payload:
            weight = -self.dynamics.gravity_acceleration * torch.ones_like(q[..., 0])
            columns, unit = weight[..., None, None] * J[..., 2:, :].mT, self.dynamics.gravity_acceleration.max()
        else:
            columns, unit = J.mT, torch.ones_like(J[(0,) * J.dim()])
        limit = (self.limit / unit).expand(columns.shape[-1])
        return weighted_estimate(state.r, columns, covariance, limit)
