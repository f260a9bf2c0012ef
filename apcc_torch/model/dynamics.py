"""Equations of motion of a soft arm of constant-curvature sections, Eqs. (33)-(38) [Dalenberg].

    M(q) qddot + C(q, qdot) qdot + G(q) + D qdot + K q = tau + tau_ext

Each section's mass is spread uniformly over its material and moves with it; a payload is a point mass at the tip.
q is (dx, dy, dL) per section in rad, rad, m, so a generalized force is in N m, N m, N.
"""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.composite_inertia import Composite, assembled, composite, solved
from apcc_torch.model.equation_of_motion import Energy
from apcc_torch.model.inertia import ArmShape, Bending, arm_shape, bending, mass_points, moments, own_momentum
from apcc_torch.model.loads import Loads, Payload, carried_wrench, distributed_load, front
from apcc_torch.model.velocity_accelerations import accelerations, generalized_force, rates
from apcc_torch.shapes import check_tensor


class SoftArmDynamics(ArmDynamics):
    """Dynamics of a batch of soft arms; parameters may differ from arm to arm through their leading dimensions.

    Args:
        lengths: (..., n_b) section rest lengths, m.
        masses: (..., n_b) section masses, kg.
        axial_stiffness: (..., n_b) on dL, N/m.
        bending_stiffness: (..., n_b) on dx and dy, N m/rad.
        damping_ratio: D = damping_ratio K, s. Used when `damping` is None.
        damping: (..., 3 n_b) diagonal of D, N m s/rad, N m s/rad, N s/m per section.
        base_rotation: (..., 3, 3) arm base to world; None is the identity. A hanging arm has diag(1, -1, -1).
        gravity: Acceleration of gravity along world -z, m/s^2.
        n_quadrature: Mass points per section.

    Raises:
        ShapeError: The parameters' shapes do not agree.
        ValueRangeError: A length, mass or stiffness is not positive, or a damping is negative.

    Example:
        >>> Arm(lengths=[0.2, 0.25]).dynamics().gravity(torch.zeros(6).double())[[2, 5]]
        tensor([-7.6300, -2.7250], dtype=torch.float64)
    """

    springs = ("bending_stiffness", "bending_stiffness", "axial_stiffness")

    axial_stiffness: Tensor
    bending_stiffness: Tensor
    powers: Tensor
    weights: Tensor
    tip: Tensor
    before: Tensor

    def __init__(
        self,
        lengths: Tensor,
        masses: Tensor,
        axial_stiffness: Tensor,
        bending_stiffness: Tensor,
        damping_ratio: float | Tensor = 0.0,
        damping: Tensor | None = None,
        base_rotation: Tensor | None = None,
        gravity: float | Tensor = 9.81,
        n_quadrature: int = 4,
    ) -> None:
        if n_quadrature < 2:
            raise ValueRangeError(f"n_quadrature must be at least 2, got {n_quadrature}")
        stiffness = {"axial_stiffness": axial_stiffness, "bending_stiffness": bending_stiffness}
        super().__init__(lengths, masses, damping_ratio, damping, base_rotation, gravity, **stiffness)
        self.n_quadrature = n_quadrature
        self.derive()

    def kinematics(self) -> PCCBackbone:
        """See `ArmDynamics.kinematics`."""
        return PCCBackbone(self.n_sections, self.base_rotation)

    def derive(self) -> None:
        """The mass points of a section, where the tip is among them, and which sections lie before each."""
        like, n_b = self.lengths.detach(), self.n_sections
        powers, weights = mass_points(self.n_quadrature, like)
        tip = like.new_zeros(self.n_quadrature + 1, n_b)
        tip[-1, -1] = 1.0
        before = like.new_ones(n_b, n_b).tril(-1)
        for name, value in {"powers": powers, "weights": weights, "tip": tip, "before": before}.items():
            self.register_buffer(name, value, persistent=False)

    def inertia(self, q: Tensor, payload: Payload = None) -> Tensor:
        """Inertia matrix M(q) (..., n, n), symmetric positive definite; arguments as for `forward`."""
        (place,), masses = self._state(payload, q=q)
        bend, base = self._bending(place)
        sums = moments(bend, masses)
        shape = arm_shape(bend, base, own_momentum(bend, sums))
        return assembled(composite(bend, shape, sums, self.before))

    def _at_rest(self, q: Tensor, payload: Payload, loads: Loads) -> Tensor:
        (place,), masses = self._state(payload, loads, q=q)
        bend, base = self._bending(place)
        shape = arm_shape(bend, base, [])
        # Gravity is the force that lifts every point, m g along world z, seen from the frame at the section's base.
        forces = masses * (self.gravity_acceleration * shape.frames[2]).unsqueeze(1)
        return self._loaded(bend, shape, forces, loads)

    def bias(self, q: Tensor, qdot: Tensor, payload: Payload = None) -> Tensor:
        """Coriolis and centrifugal forces C(q, qdot) qdot (..., n); arguments as for `forward`."""
        (place, rate), masses = self._state(payload, q=q, qdot=qdot)
        bend, base = self._bending(place)
        motion = rates(bend, rate, self.powers)
        shape = arm_shape(bend, base, motion.columns)
        forces = masses * accelerations(bend, motion, shape, rate, self.before, None)
        return generalized_force(bend, shape, forces, self.before)

    def coriolis(self, q: Tensor, qdot: Tensor, payload: Payload = None) -> Tensor:
        """Coriolis matrix C(q, qdot) (..., n, n) from Christoffel symbols, Eqs. (36)-(37) [Dalenberg].

        The symbols are symmetric in their last two indices, so they are the polar form of the quadratic map
        b(v) = C(q, v) v, and column j of C(q, v) is (b(v + e_j) - b(v - e_j)) / 4: exact, without a derivative of M.
        Arguments as for `forward`.
        """
        n = 3 * self.n_sections
        for name, value in {"q": q, "qdot": qdot}.items():
            check_tensor(name, value, (n,))
        dims = len(self.batch_of(payload, q=(q, 1), qdot=(qdot, 1)))
        axes = torch.eye(n, dtype=q.dtype, device=q.device)
        axes = torch.cat((axes, -axes)).view(2 * n, *[1] * dims, n)
        columns = self.bias(q, qdot + axes, payload).unflatten(0, (2, n))
        # Eqs. (36) and (37), by polarization.
        return 0.25 * (columns[0] - columns[1]).movedim(0, -1)

    def energy(self, q: Tensor, qdot: Tensor, payload: Payload = None) -> Energy:
        """See `ArmDynamics.energy`."""
        (place, rate), masses = self._state(payload, q=q, qdot=qdot)
        bend, base = self._bending(place)
        sums = moments(bend, masses)
        shape = arm_shape(bend, base, own_momentum(bend, sums))
        inertia = assembled(composite(bend, shape, sums, self.before))
        velocity = rate.movedim(0, -1)
        kinetic = 0.5 * (velocity * (inertia @ velocity.unsqueeze(-1)).squeeze(-1)).sum(-1)
        # First moment of a section about its base: L times the momentum of its stretching column.
        height = sums.mass * shape.bases[2] + bend.length * shape.local[2, 2]
        gravity = self.gravity_acceleration * height.sum(0)
        elastic = 0.5 * (self.stiffness_diagonal * q * q).sum(-1)
        return Energy(kinetic, gravity + elastic, gravity, elastic.expand_as(gravity))

    def _in_motion(self, q: Tensor, qdot: Tensor, payload: Payload, loads: Loads) -> tuple[Composite, Tensor]:
        (place, rate), masses = self._state(payload, loads, q=q, qdot=qdot)
        bend, base = self._bending(place)
        sums = moments(bend, masses)
        motion = rates(bend, rate, self.powers)
        shape = arm_shape(bend, base, own_momentum(bend, sums) + motion.columns)
        forces = masses * accelerations(bend, motion, shape, rate, self.before, self.gravity_acceleration)
        bias = self._loaded(bend, shape, forces, loads)
        return composite(bend, shape, sums, self.before), bias

    def _assembled(self, inertia: Composite) -> Tensor:
        return assembled(inertia)

    def _solved(self, inertia: Composite, force: Tensor) -> Tensor:
        return solved(inertia, force)

    def _bending(self, place: Tensor) -> tuple[Bending, Tensor]:
        dims = place.dim() - 1
        return bending(place, front(self.lengths, 1, dims), self.powers), front(self.base_rotation, 2, dims)

    def _loaded(self, bend: Bending, shape: ArmShape, forces: Tensor, loads: Loads) -> Tensor:
        """Generalized force (..., n) of forces (3, K, n_b, *batch) on the points, less that of external loads."""
        if loads.distributed is not None:
            share = front(self.weights, 1, bend.x.dim()) * front(self.lengths, 1, bend.x.dim() - 1)
            forces = forces - distributed_load(shape, loads.distributed, share)
        carried = carried_wrench(shape, loads, self.before)
        return generalized_force(bend, shape, forces, self.before, None if carried is None else -carried)

    def _state(
        self, payload: Payload, loads: Loads | None = None, **coordinates: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Coordinates and point masses in the layout of `inertia`: (component, *batch) and (K, n_b, *batch)."""
        batch = self.checked(payload, loads, **coordinates)
        values = [v.expand(*batch, self.n).movedim(-1, 0).contiguous() for v in coordinates.values()]
        dims = len(batch)
        masses = front(self.weights, 1, dims + 1) * front(self.masses, 1, dims)
        if payload is not None:
            tip = front(self.tip, 2, dims)
            masses = masses + (front(payload, 0, dims) if isinstance(payload, Tensor) else payload) * tip
        return values, masses
