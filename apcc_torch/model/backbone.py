"""The piecewise constant-curvature backbone: poses, points and analytic Jacobians of an arm of n_b sections."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple, section_fractions
from apcc_torch.model.arc import arc_pose
from apcc_torch.model.chain import Chain, body_jacobian, build_chain, tip_jacobian
from apcc_torch.model.regressor import jacobian_rate, linear_regressor
from apcc_torch.settings import hold_rows
from apcc_torch.shapes import batch_shape, check_same, check_tensor

HANGING = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""Base rotation of an arm that hangs from a ceiling: pi about x, so the arm lies at world z <= 0."""


def split_configuration(q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """q (..., 3 n_b) -> Delta_x, Delta_y (rad) and delta L (m), each (..., n_b)."""
    x, y, dL = q.unflatten(-1, (-1, 3)).unbind(-1)
    return x, y, dL


class MaterialPoints(NamedTuple):
    """Where k material points lie on an arm, whatever its configuration.

    fraction: (..., k, n_b) part of each section that lies before the point.
    length: (..., k, n_b) rest length of that part, m.
    section: (..., k) int64 zero-based index of the section that the point is in.
    """

    fraction: Tensor
    length: Tensor
    section: Tensor

    def with_tip(self, L0: Tensor) -> MaterialPoints:
        """The points and after them the arm's tip, for rest lengths L0 (..., n_b) of the same leading shape."""
        n_b = L0.shape[-1]
        fraction = torch.nn.functional.pad(self.fraction, (0, 0, 0, 1), value=1.0)
        section = torch.nn.functional.pad(self.section, (0, 1), value=n_b - 1)
        return MaterialPoints(fraction, torch.cat((self.length, L0.unsqueeze(-2)), dim=-2), section)


class PCCBackbone(nn.Module):
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
    """

    base_rotation: Tensor

    def __init__(self, n_sections: int = 3, base_rotation: Tensor | None = None) -> None:
        super().__init__()
        if n_sections < 1:
            raise ValueRangeError(f"n_sections must be at least 1, got {n_sections}")
        if base_rotation is None:
            base_rotation = torch.eye(3, dtype=torch.float64)
        check_tensor("base_rotation", base_rotation, (3, 3))
        rotation = base_rotation.detach().to(torch.float64)
        defect = (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64, device=rotation.device)).abs().max()
        if not (float(defect) < 1e-4 and float(torch.linalg.det(rotation)) > 0.0):
            raise ValueRangeError("base_rotation must be a rotation matrix (orthonormal, determinant 1)")
        self.n_sections = n_sections
        hold_rows(self, base_rotation=(base_rotation.detach().clone(), 2))

    @property
    def n(self) -> int:
        """Number of configuration variables, 3 n_b."""
        return 3 * self.n_sections

    def check(self, q: Tensor, L0: Tensor) -> None:
        """Raises ShapeError or DtypeError where q is not (..., 3 n_b), L0 not (..., n_b), or they do not match."""
        check_tensor("q", q, (self.n,))
        check_tensor("L0", L0, (self.n_sections,))
        check_same(q=q, L0=L0)
        batch_shape(q=(q, 1), L0=(L0, 1))

    def _check_points(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> torch.Size:
        """The batch shape of poses at points; raises where q, L0, X_tilde and j do not fit each other."""
        self.check(q, L0)
        check_tensor("X_tilde", X_tilde, (None,))
        check_same(q=q, X_tilde=X_tilde)
        if j.dtype != torch.int64:
            raise DtypeError(f"j must be torch.int64, got {j.dtype}")
        if j.shape[-1:] != X_tilde.shape[-1:]:
            raise ShapeError(f"j must have shape (..., {X_tilde.shape[-1]}) as X_tilde has, got {tuple(j.shape)}")
        return batch_shape(q=(q, 1), L0=(L0, 1), X_tilde=(X_tilde, 1), j=(j, 1))

    def _base(self, like: Tensor) -> Tensor:
        return self.base_rotation.to(dtype=like.dtype, device=like.device)

    def chain(self, q: Tensor, L0: Tensor) -> Chain:
        """The whole arm as a chain of arcs: what its tip, `chain.tip_jacobian` and `regressor.jacobian_rate` share.

        The shapes of q (..., 3 n_b) and L0 (..., n_b) are not checked here.
        """
        x, y, dL = split_configuration(q)
        length = L0 + dL
        if length.shape != x.shape:
            x, y = x.expand_as(length), y.expand_as(length)
        return build_chain(x, y, length, self._base(q))

    def chain_to(self, q: Tensor, points: MaterialPoints) -> Chain:
        """The arm up to each material point, as a chain (..., k) whose tip is that point; unchecked.

        The leading dimensions of q (..., 3 n_b) are those of the points.
        """
        parts = q.unflatten(-1, (-1, 3)).unsqueeze(-3) * points.fraction.unsqueeze(-1)
        x, y, dL = parts.unbind(-1)
        return build_chain(x, y, dL + points.length, self._base(q))

    def material_points(self, L0: Tensor, X_tilde: Tensor, j: Tensor) -> MaterialPoints:
        """Points (..., k) as parts of the sections, all of one leading shape; unchecked. Arguments as `pose`."""
        fraction = section_fractions(X_tilde, j, self.n_sections)
        return MaterialPoints(fraction, L0.unsqueeze(-2) * fraction, j)

    def tip(self, q: Tensor, L0: Tensor) -> Tensor:
        """Tip position x(q, pi), (..., 3) m, world frame. Eq. (3) [Dalenberg]."""
        self.check(q, L0)
        return self.chain(q, L0).tip

    def tip_jacobian(self, q: Tensor, L0: Tensor) -> Tensor:
        """J (..., 3, n): tip velocity is J qdot, world frame. Eq. (4) [Dalenberg]."""
        self.check(q, L0)
        return tip_jacobian(self.chain(q, L0))

    def tip_and_jacobian(self, q: Tensor, L0: Tensor) -> tuple[Tensor, Tensor]:
        """Tip position (..., 3) and Jacobian (..., 3, n) from one pass."""
        self.check(q, L0)
        chain = self.chain(q, L0)
        return chain.tip, tip_jacobian(chain)

    def pose(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> Tensor:
        """Poses of material points, h(q, X_tilde, pi). Eq. (27) [Dalenberg].

        Args:
            q: (..., 3 n_b) configuration.
            L0: (..., n_b) rest lengths, m.
            X_tilde: (..., k) normalised abscissa in its section, from `decouple`.
            j: (..., k) int64 zero-based section index.

        Returns:
            (..., k, 4, 4) world frame.

        Raises:
            ShapeError, DtypeError: The arguments do not fit each other.
        """
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

    def pose_and_body_jacobian(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> tuple[Tensor, Tensor]:
        """Poses (..., k, 4, 4) and body Jacobians (..., k, 6, n) of material points, from one pass.

        Arguments as `pose`. Rows of the Jacobian: angular, then linear velocity in the point's own axes, rad/s and
        m/s. Eqs. (27), (29) [Dalenberg].
        """
        batch = self._check_points(q, L0, X_tilde, j)
        points = self.material_points(L0, X_tilde, j)
        chain = self.chain_to(q.expand(*batch, q.shape[-1]), points)
        return se3.pose(chain.rotation, chain.tip), body_jacobian(chain, points.fraction)

    def body_jacobian(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> Tensor:
        """J_b (..., k, 6, n) of material points; see `pose_and_body_jacobian`. Eq. (29) [Dalenberg]."""
        return self.pose_and_body_jacobian(q, L0, X_tilde, j)[1]

    def body_parameter_jacobian(self, q: Tensor, L0: Tensor, X: Tensor, body_jacobian: Tensor) -> Tensor:
        """Body twist of material points per unit change of each rest length, with q fixed.

        A longer section moves what it carries as a larger delta L would, and it shifts the point's normalised
        abscissa, which slides the point along its section's constant strain (-y, x, 0, 0, 0, L).

        Args:
            q: (..., 3 n_b) configuration.
            L0: (..., n_b) rest lengths, m.
            X: (..., k) material abscissae, m.
            body_jacobian: (..., k, 6, n) at the same point, from `pose_and_body_jacobian`.

        Returns:
            (..., k, 6, n_b), rad/m and m/m.
        """
        batch = batch_shape(q=(q, 1), L0=(L0, 1), X=(X, 1))
        L0 = L0.expand(*batch, self.n_sections)
        points = self.material_points(L0, *decouple(X, L0))
        return self.parameter_columns(q.expand(*batch, self.n), L0, X, points, body_jacobian)

    def parameter_columns(
        self, q: Tensor, L0: Tensor, X: Tensor, points: MaterialPoints, body_jacobian: Tensor
    ) -> Tensor:
        """`body_parameter_jacobian` where the points are known; unchecked, q, L0 and points of one leading shape."""
        x, y, dL = split_configuration(q)
        zero = torch.zeros_like(x)
        strain = torch.stack((-y, x, zero, zero, zero, L0 + dL), dim=-1)  # (..., n_b, 6)
        strain = torch.gather(strain, -2, points.section.unsqueeze(-1).expand(*points.section.shape, 6))
        rest = torch.gather(L0, -1, points.section)
        # Eq. (25) differentiated: dX_tilde/dpi_m is -1/pi_j before section j, -X_tilde/pi_j in it; 0 once clamped.
        # The arm's end is the one `decouple` compares with, to the last bit: the last sensor often sits exactly there.
        inside = (L0.cumsum(-1)[..., -1:] >= X).to(q.dtype) / rest
        slide = -points.fraction * inside.unsqueeze(-1)
        return body_jacobian[..., 2::3] + strain.unsqueeze(-1) * slide.unsqueeze(-2)

    def points(self, q: Tensor, L0: Tensor, N: int, spacing: str = "arc") -> Tensor:
        """N points along the backbone from base to tip, (..., N, 3) m, world frame.

        Args:
            q: (..., 3 n_b) configuration.
            L0: (..., n_b) rest lengths, m.
            N: Number of points.
            spacing: "arc", evenly along the curve as it is, so that the points depend on the curve alone; or
                "material", evenly in rest length, so that each is one material point.

        Raises:
            ValueRangeError: N < 2, or an unknown spacing.
        """
        if N < 2:
            raise ValueRangeError(f"N must be at least 2, got {N}")
        if spacing not in ("arc", "material"):
            raise ValueRangeError(f"spacing must be arc or material, got {spacing!r}")
        self.check(q, L0)
        # A section squeezed to nothing holds no points; the floor keeps its neighbours' points finite.
        measure = L0 if spacing == "material" else (L0 + q[..., 2::3]).clamp(min=1e-9)
        share = torch.linspace(0.0, 1.0, N, dtype=q.dtype, device=q.device)
        X_tilde, j = decouple(share * measure.sum(-1, keepdim=True), measure)
        return self.pose(q, L0, X_tilde, j)[..., :3, 3]

    def regressor(self, q: Tensor, qdot: Tensor) -> tuple[Tensor, Tensor]:
        """Y (..., 3, n_b) and Phi (..., 3) with Y @ L0 + Phi = J(q, L0) qdot. Theorem 1, Eq. (2) [Dalenberg].

        Raises:
            ShapeError, DtypeError: q or qdot is not (..., 3 n_b), or they do not match.
        """
        check_tensor("q", q, (self.n,))
        check_tensor("qdot", qdot, (self.n,))
        check_same(q=q, qdot=qdot)
        batch_shape(q=(q, 1), qdot=(qdot, 1))
        q, qdot = torch.broadcast_tensors(q, qdot)
        return linear_regressor(split_configuration(q), split_configuration(qdot), self._base(q))

    def tip_jacobian_rate(self, q: Tensor, qdot: Tensor, L0: Tensor) -> Tensor:
        """Jdot (..., 3, n) along qdot; by symmetry of second derivatives also d(J qdot)/dq."""
        self.check(q, L0)
        check_tensor("qdot", qdot, (self.n,))
        check_same(q=q, qdot=qdot)
        batch_shape(q=(q, 1), qdot=(qdot, 1), L0=(L0, 1))
        q, qdot = torch.broadcast_tensors(q, qdot)
        chain = self.chain(q, L0)
        xdot, ydot, lengthdot = (rate.expand_as(chain.length) for rate in split_configuration(qdot))
        return jacobian_rate(chain, (xdot, ydot, lengthdot))
