"""The arm's dynamics as a linear function of what is uncertain in them: rigidities, tendon friction, payload and mass.

With the rest lengths given, the equation of motion of a PCC arm is

    M a + C(q, qdot) v + G + K q_e + D v + c B B^T v = Y_d(q, qdot, v, a) theta

with no constant part. In Slotine and Li's form v and a are reference velocity and acceleration; at v = qdot, a = qddot
and q_e = q it is Eq. (33) [Dalenberg] itself. C is the matrix of the Christoffel symbols, Eqs. (36)-(37), so that
Mdot - 2 C is skew-symmetric.
"""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.model.composite_inertia import assembled, composite
from apcc_torch.model.inertia import arm_shape, bending, mass_points, moments, own_momentum
from apcc_torch.model.loads import front
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.model.velocity_accelerations import accelerations, generalized_force, rates
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import check_setting
from apcc_torch.shapes import batch_shape, check_finite, check_same, check_tensor

PARAMETERS = ("bending_rigidity", "axial_rigidity", "tendon_damping", "payload", "mass")
"""theta in order: E I, N m^2; E A, N; c, N s/m of every tendon in its guides; the payload at the tip and the arm, kg.

A section of rest length l has the stiffnesses E I / l on its bends and E A / l on its elongation, and the share of the
mass that it has of the length.
"""


class DynamicsRegressor(Part):
    """Y_d of a hanging or standing arm of constant-curvature sections, for rest lengths given at every call.

    Args:
        routing: The tendons, whose friction acts on the arm.
        base_rotation: (3, 3) arm base to world; a hanging arm has diag(1, -1, -1).
        damping_ratio: D = damping_ratio K, s: known, and so in the columns of the rigidities.
        gravity: Acceleration of gravity along world -z, m/s^2.
        n_quadrature: Mass points per section.

    Raises:
        ShapeError: base_rotation is not (3, 3).
        ValueRangeError: n_quadrature is below 2, the ratio is negative, or a number is not finite.

    Example:
        >>> arm = Arm(lengths=[0.2, 0.25])
        >>> regressor = DynamicsRegressor(arm.routing(), arm.base_rotation())
        >>> still = torch.zeros(6).double()
        >>> regressor(still, still, still, still, arm.rest_lengths()).shape
        torch.Size([6, 5])
    """

    base_rotation: Tensor
    powers: Tensor
    weights: Tensor
    tip: Tensor

    def __init__(
        self,
        routing: TendonRouting,
        base_rotation: Tensor,
        damping_ratio: float = 0.1,
        gravity: float = 9.81,
        n_quadrature: int = 4,
    ) -> None:
        super().__init__()
        check_finite("base_rotation", check_tensor("base_rotation", base_rotation, (3, 3)))
        if n_quadrature < 2:
            raise ValueRangeError(f"n_quadrature must be at least 2, got {n_quadrature}")
        if not abs(gravity) < float("inf"):
            raise ValueRangeError(f"gravity must be finite, got {gravity}")
        self.n_quadrature = n_quadrature
        self.routing = routing
        self.damping_ratio = check_setting("damping_ratio", damping_ratio, zero=True)
        self.gravity = gravity
        hold_rows(self, base_rotation=(base_rotation, 2))
        self.derive()

    def derive(self) -> None:
        """The mass points of a section."""
        powers, weights = mass_points(self.n_quadrature, self.base_rotation.detach())
        # The last of the points is the section's tip, which has no weight of its own.
        tip = torch.zeros_like(weights)
        tip[-1] = 1.0
        for name, value in {"powers": powers, "weights": weights, "tip": tip}.items():
            self.register_buffer(name, value, persistent=False)

    def forward(
        self, q: Tensor, qdot: Tensor, v: Tensor, a: Tensor, L0: Tensor, q_elastic: Tensor | None = None
    ) -> Tensor:
        """Y_d (..., 3 n_b, 5), columns as `PARAMETERS`, rows N m, N m, N a section, per unit of the parameter.

        Args:
            q: (..., 3 n_b) rad, rad, m.
            qdot: (..., 3 n_b) rad/s, rad/s, m/s.
            v: (..., 3 n_b) what C, D and the tendons' friction multiply.
            a: (..., 3 n_b) what M multiplies.
            L0: (..., n_b) rest lengths, m.
            q_elastic: (..., 3 n_b) what K multiplies; None for q.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """
        check_tensor("L0", L0, (None,))
        given = {"q": q, "qdot": qdot, "v": v, "a": a, "q_elastic": q if q_elastic is None else q_elastic}
        n = 3 * L0.shape[-1]
        for name, value in given.items():
            check_tensor(name, value, (n,))
        check_same(L0=L0, **given)
        batch = batch_shape(L0=(L0, 1), **{name: (value, 1) for name, value in given.items()})
        q, qdot, v, a, stretched = (value.expand(*batch, n) for value in given.values())
        L0 = L0.expand(*batch, L0.shape[-1])
        # D = ratio K: one material, one time constant.
        relative = ((stretched + self.damping_ratio * v).unflatten(-1, (-1, 3)) / L0.unsqueeze(-1)).movedim(-1, 0)
        zero = torch.zeros_like(L0)
        bend = torch.stack((relative[0], relative[1], zero), dim=-1).flatten(-2)
        axial = torch.stack((zero, zero, relative[2]), dim=-1).flatten(-2)
        B = self.routing.matrix(L0)
        friction = (B @ (B.mT @ v.unsqueeze(-1))).squeeze(-1)
        return torch.stack((bend, axial, friction, *self._masses(q, qdot, v, a, L0)), dim=-1)

    def _masses(self, q: Tensor, qdot: Tensor, v: Tensor, a: Tensor, L0: Tensor) -> tuple[Tensor, Tensor]:
        """M a + C v + G (..., n) of one kilogram at the tip, and of one spread over the arm; of one leading shape.

        C v is the polar form of the quadratic map b(v) = C(q, v) v: (b(qdot + v) - b(qdot - v)) / 4. The accelerations
        behind b are the same for both masses, and M is the same for both velocities: one further dimension of two
        serves as masses in the one and as velocities in the other.
        """
        dims = q.dim()  # those of the batch, and the further one in front of them
        place = torch.stack((q, q)).movedim(-1, 0)
        velocity = torch.stack((qdot + v, qdot - v)).movedim(-1, 0)
        lengths = torch.stack((L0, L0)).movedim(-1, 0)
        n_b = L0.shape[-1]
        share = (L0 / L0.sum(-1, keepdim=True)).movedim(-1, 0)
        spread = front(self.weights, 1, dims) * share
        identity = torch.eye(n_b, dtype=q.dtype, device=q.device)
        end = front(self.tip.unsqueeze(-1) * identity[-1], 2, dims - 1)
        masses = torch.stack((end.expand_as(spread), spread), dim=2)
        before = torch.ones_like(identity).tril(-1)

        bend = bending(place, lengths, self.powers)
        sums = moments(bend, masses)
        motion = rates(bend, velocity, self.powers)
        base = front(self.base_rotation, 2, dims)
        shape = arm_shape(bend, base, own_momentum(bend, sums) + motion.columns)
        inertia = assembled(composite(bend, shape, sums, before))
        quadratic = accelerations(bend, motion, shape, velocity, before, None)
        # Gravity is the force that lifts every point, m g along world z, seen from the frame at the section's base.
        lift = self.gravity * shape.frames[2, :, :, 0].unsqueeze(1)
        point = 0.25 * (quadratic[:, :, :, 0] - quadratic[:, :, :, 1]) + lift
        force = generalized_force(bend, shape, masses * point.unsqueeze(3), before)
        total = force + (inertia @ a.unsqueeze(-1)).squeeze(-1)
        return total[0], total[1]
