"""The piecewise constant-curvature backbone: poses, points and analytic Jacobians of an arm of n_b sections."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.lie import se3
from apcc_torch.model.abscissae import MaterialPoints
from apcc_torch.model.arc import arc_pose, squared_bend
from apcc_torch.model.chain import Chain, build_chain
from apcc_torch.model.coordinates import CONSTANT_CURVATURE
from apcc_torch.model.kinematic_model import KinematicModel, PointDerivatives
from apcc_torch.model.regressor import linear_regressor
from apcc_torch.model.tendons import TendonRouting

HANGING = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""Base rotation of an arm that hangs from a ceiling: pi about x, so the arm lies at world z <= 0."""


def split_configuration(q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """q (..., 3 n_b) -> Delta_x, Delta_y (rad) and delta L (m), each (..., n_b)."""
    x, y, dL = q.unflatten(-1, (-1, 3)).unbind(-1)
    return x, y, dL


class PCCBackbone(KinematicModel):
    """Kinematics of n_b extensible constant-curvature sections in series. Eqs. (1)-(12) [Dalenberg].

    Configurations q are (..., 3 n_b), per section (Delta_x rad, Delta_y rad, delta L m); rest lengths L0 are
    (..., n_b), m. Leading dimensions broadcast. Everything is expressed in the world frame, whose origin is the base
    of the arm.

    Args:
        n_sections: Number of sections n_b.
        base_rotation: (3, 3) rotation of the arm's base frame in the world; None for the identity.

    Raises:
        ValueRangeError: n_sections < 1, or base_rotation is not a rotation.
        ShapeError: base_rotation is not (3, 3).

    Example:
        >>> backbone, L0 = PCCBackbone(2), torch.tensor([0.2, 0.25])
        >>> backbone.tip(torch.zeros(6), L0)
        tensor([0.0000, 0.0000, 0.4500])
        >>> backbone.tip(torch.tensor([0.5, 0.0, 0.0, -0.5, 0.0, 0.01]), L0)
        tensor([0.1126, 0.0000, 0.4411])
    """

    def __init__(self, n_sections: int = 3, base_rotation: Tensor | None = None) -> None:
        super().__init__(n_sections, CONSTANT_CURVATURE, base_rotation)

    @property
    def n(self) -> int:
        """Number of configuration variables, 3 n_b."""
        return 3 * self.n_sections

    def resized(self, n_sections: int) -> PCCBackbone:
        """See `KinematicModel.resized`."""
        return PCCBackbone(n_sections, self.base_rotation)

    def chain(self, q: Tensor, L0: Tensor) -> Chain:
        """See `KinematicModel.chain`; q (..., 3 n_b) and L0 (..., n_b) broadcast, and their shapes are not checked."""
        x, y, dL = split_configuration(q)
        length = L0 + dL
        if length.shape != x.shape:
            x, y = x.expand_as(length), y.expand_as(length)
        return build_chain(x, y, length, self._base(q))

    def _chain(self, q: Tensor, L0: Tensor) -> Chain:
        self.check(q, L0)
        return self.chain(q, L0)

    def chain_to(self, q: Tensor, points: MaterialPoints) -> Chain:
        """See `KinematicModel.chain_to`; the leading dimensions of q (..., 3 n_b) are those of the points."""
        parts = q.unflatten(-1, (-1, 3)).unsqueeze(-3) * points.fraction.unsqueeze(-1)
        x, y, dL = parts.unbind(-1)
        return build_chain(x, y, dL + points.length, self._base(q), points.fraction)

    def second_order(
        self, q: Tensor, L0: Tensor, points: MaterialPoints, chain: Chain, gradient: Tensor, slope: Tensor
    ) -> PointDerivatives:
        """See `KinematicModel.second_order`: all coordinates of a section's part are the fraction times its own."""
        of_arcs = chain.second_order(gradient, slope)
        fraction, own = (v.unsqueeze(-1).expand(*v.shape, 3).flatten(-2) for v in (points.fraction, points.own))
        slide = own * (q + self.coordinates.on_elongations(L0)).unsqueeze(-2)
        moved = fraction * (of_arcs.hessian @ slide.unsqueeze(-1)).squeeze(-1) + own * of_arcs.gradient
        hessian = fraction.unsqueeze(-1) * of_arcs.hessian * fraction.unsqueeze(-2)
        return PointDerivatives(fraction * of_arcs.gradient, hessian, moved)

    def strain(self, q: Tensor, L0: Tensor, points: MaterialPoints) -> Tensor:
        """A section's constant strain (-y, x, 0, 0, 0, L), (..., k, 6)."""
        x, y, dL = split_configuration(q)
        zero = torch.zeros_like(x)
        strain = torch.stack((-y, x, zero, zero, zero, L0 + dL), dim=-1)  # (..., n_b, 6)
        return torch.gather(strain, -2, points.section.unsqueeze(-1).expand(*points.section.shape, 6))

    def section_lengths(self, q: Tensor, L0: Tensor) -> Tensor:
        """L0 + delta L (..., n_b), m."""
        return L0 + q[..., 2::3]

    def tendon_matrix(self, routing: TendonRouting, pi_hat: Tensor) -> Tensor:
        """B(pi_hat) (..., 3 n_b, n_a), with which B^T q is exact. Eqs. (42)-(46) [Dalenberg]."""
        return routing.matrix(pi_hat)

    def pose(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> Tensor:
        """Poses (..., k, 4, 4) of material points; see `KinematicModel.pose`. Eq. (27) [Dalenberg]."""
        batch = self._check_points(q, L0, X_tilde, j)
        chain = self.chain(q, L0)
        k, n = X_tilde.shape[-1], self.n_sections
        j = j.expand(*batch, k)
        x, y, _ = split_configuration(q)

        def at_point(values: Tensor) -> Tensor:
            return torch.gather(values.expand(*batch, n), -1, j)

        rotation, chord = arc_pose(X_tilde * at_point(x), X_tilde * at_point(y))
        offset = chord * (X_tilde * at_point(chain.length)).unsqueeze(-1)
        index = j[..., None, None].expand(*batch, k, 3, 3)
        before = torch.gather(chain.before.expand(*batch, n, 3, 3), -3, index)
        starts = torch.nn.functional.pad(chain.ends[..., :-1, :], (0, 0, 1, 0))
        start = torch.gather(starts.expand(*batch, n, 3), -2, index[..., 0])
        return se3.pose(before @ rotation, start + (before @ offset.unsqueeze(-1)).squeeze(-1))

    def curve(self, q: Tensor, L0: Tensor, share: Tensor) -> Tensor:
        """See `KinematicModel.curve`; without a lookup of each point's section.

        Every section adds its arc up to the point: nothing before it begins, all of it once it has ended. An arc of
        angle phi and curvature kappa reaches sin(phi) / kappa along its first tangent and (1 - cos(phi)) / kappa
        towards its bend; by the half angle h = phi / 2 these are 2 sin(h) cos(h) / kappa and 2 sin(h)^2 / kappa, exact
        however small kappa is.
        """
        chain = self.chain(q, L0)
        # A section squeezed to nothing has the floor of `points`, a straight one a bend that cannot be seen.
        measure = self.section_lengths(q, L0).clamp(min=1e-9)
        ends = measure.cumsum(-1)
        bend = torch.sqrt(squared_bend(chain.x, chain.y)).clamp(min=1e-30)
        half = 0.5 * bend
        rate = half / measure
        begin, whole = (rate * (measure - ends)).unsqueeze(-1), (rate * ends[..., -1:]).unsqueeze(-1)
        h = torch.clamp(torch.addcmul(begin, share, whole), torch.zeros_like(begin), half.unsqueeze(-1))
        sine = torch.sin(h)
        x, y, z = (chain.before * (chain.length / half)[..., None, None]).unbind(-1)
        towards = (chain.x / bend).unsqueeze(-1) * x + (chain.y / bend).unsqueeze(-1) * y
        return torch.baddbmm(towards.mT @ (sine * sine), z.mT, sine * torch.cos(h))

    def regressor(self, q: Tensor, qdot: Tensor) -> tuple[Tensor, Tensor]:
        """See `KinematicModel.regressor`, in closed form. Theorem 1, Eq. (2) [Dalenberg]."""
        self._check_rates(q, qdot)
        q, qdot = torch.broadcast_tensors(q, qdot)
        return linear_regressor(split_configuration(q), split_configuration(qdot), self._base(q))
