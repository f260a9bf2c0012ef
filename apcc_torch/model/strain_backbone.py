"""Sections whose strain is a polynomial of the abscissa: one kinematic model for every such basis.

Along section i, of normalised abscissa s, the backbone's frame T moves by dT/ds = T hat(xi(s)) with the strain

    xi(s) = (S_0 + s S_1) a,    a = (coordinates of the section, its length L0 + delta L last),

angular (rad) over linear (m). The section is cut into rods. Over a rod of length h and middle m, Magnus' expansion of
order 4 gives the one twist that moves the frame as far,

    Omega = h xi(m) + h^3 / 12 [S_0 a, S_1 a],

whose error falls with h^4; it is exact where S_1 = 0. Its angular part is free of L0 and its linear part linear in it,
and so is J_l(omega) v: the velocity of the tip stays exactly linear in the rest lengths, whatever the number of rods.
The part of a section up to s is a section of the same kind, of coordinates P(s) a = (s P_1 + s^2 P_2) a.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.lie import se3
from apcc_torch.model.abscissae import MaterialPoints
from apcc_torch.model.coordinates import Coordinates
from apcc_torch.model.kinematic_model import KinematicModel, PointDerivatives
from apcc_torch.model.strain_chain import Chosen, StrainChain, Twists, build_strain_chain, rod_poses, spread
from apcc_torch.model.tendons import TendonRouting


class Basis(NamedTuple):
    """How c coordinates of a section, its length last, make its strain; see the module's head.

    S_0, S_1: (6, c); S_1 None for a constant strain.
    P_1, P_2: (c, c); P_2 None likewise, where P_1 is the identity.
    """

    S_0: Tensor
    S_1: Tensor | None
    P_1: Tensor
    P_2: Tensor | None


class StrainBackbone(KinematicModel):
    """Sections of one strain basis in series.

    Args:
        n_sections: Number of sections n_b.
        coordinates: What q is made of.
        basis: Of each section.
        rods: Rods of each section.
        base_rotation: (3, 3) rotation of the arm's base frame in the world; None for the identity.
        chosen: Which of the sections' coordinates q has; None for all.

    Raises:
        ValueRangeError: n_sections < 1, or base_rotation is not a rotation.
        ShapeError: base_rotation is not (3, 3).
    """

    first: Tensor
    second: Tensor | None
    strain_start: Tensor
    strain_slope: Tensor | None
    part_first: Tensor
    part_second: Tensor | None
    places: Tensor | None
    entries: Tensor | None

    def __init__(
        self,
        n_sections: int,
        coordinates: Coordinates,
        basis: Basis,
        rods: int,
        base_rotation: Tensor | None = None,
        chosen: Chosen | None = None,
    ) -> None:
        super().__init__(n_sections, coordinates, base_rotation)
        self.rods, self.basis, self.chosen = rods, basis, chosen
        self.derive()

    def derive(self) -> None:
        """The twists of a section's rods, and the basis and the places of its coordinates beside the base rotation."""
        like, rods, basis, chosen = self.base_rotation, self.rods, self.basis, self.chosen
        h = 1.0 / rods
        middles = torch.arange(rods, dtype=torch.float64, device="cpu").add(0.5).mul(h)
        first = basis.S_0.expand(rods, *basis.S_0.shape)
        second = None
        if basis.S_1 is not None:
            first = first + middles[:, None, None] * basis.S_1
            bracket = _bracket(basis.S_0, basis.S_1)
            second = (h**3 / 12.0 * (bracket + bracket.mT)).to(like)
        constants: dict[str, Tensor | None] = {
            "first": h * first,
            "strain_start": basis.S_0,
            "strain_slope": basis.S_1,
            "part_first": basis.P_1,
            "part_second": basis.P_2,
        }
        placed = {name: None if value is None else value.to(like) for name, value in constants.items()}
        placed |= {"second": second, "places": None, "entries": None}
        if chosen is not None:
            placed |= {"places": chosen.places.to(like.device), "entries": chosen.entries.to(like.device)}
        for name, value in placed.items():
            self.register_buffer(name, value, persistent=False)

    @property
    def n(self) -> int:
        """Number of configuration variables."""
        return self.n_sections * self.first.shape[-1] if self.places is None else self.places.shape[0]

    @property
    def _chosen(self) -> Chosen | None:
        if self.places is None or self.entries is None:
            return None
        return Chosen(self.places, self.entries)

    def _own(self, q: Tensor) -> Tensor:
        """(..., n_b, c) coordinates of each section, zero for those that q has not; delta L last."""
        return spread(q, self._chosen, self.n_sections, self.first.shape[-1])

    def _parts(self, fraction: Tensor) -> Tensor | None:
        """P (..., c, c) of the parts of sections (...); None where it is the fraction times the identity."""
        if self.part_second is None:
            return None
        f = fraction[..., None, None]
        return f * self.part_first.to(f) + f * f * self.part_second.to(f)

    def _twists(self, a: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Twist, directions and curvature as in `Twists`, for coordinates with lengths a (..., n_b, c)."""
        first = self.first.to(a)
        shape = (*a.shape[:-1], *first.shape)
        if self.second is None:
            directions, curvature = first.expand(shape), None
            twist = directions @ a[..., None, :, None]
        else:
            second = self.second.to(a)
            bent = (second.flatten(0, 1) @ a.unsqueeze(-1)).unflatten(-2, second.shape[:2]).squeeze(-1).unsqueeze(-3)
            directions, curvature = first + bent, second.expand(first.shape[0], *second.shape)
            twist = (first + 0.5 * bent) @ a[..., None, :, None]
        return twist.squeeze(-1), directions, curvature

    def chain(self, q: Tensor, L0: Tensor) -> StrainChain:
        """See `KinematicModel.chain`; q (..., n) and L0 (..., n_b) broadcast, and their shapes are not checked."""
        twist, directions, curvature = self._twists(_lengthened(self._own(q), L0))
        return build_strain_chain(Twists(twist, directions, curvature, None, self._chosen), self._base(q))

    def chain_to(self, q: Tensor, points: MaterialPoints) -> StrainChain:
        """See `KinematicModel.chain_to`; the leading dimensions of q (..., n) are those of the points."""
        own, part = self._own(q).unsqueeze(-3), self._parts(points.fraction)
        if part is None:
            a = own * points.fraction.unsqueeze(-1)
            identity = torch.eye(own.shape[-1], dtype=q.dtype, device=q.device)
            part = points.fraction[..., None, None] * identity
        else:
            a = (part @ own.unsqueeze(-1)).squeeze(-1)
        twist, directions, curvature = self._twists(_lengthened(a, points.length))
        return build_strain_chain(Twists(twist, directions, curvature, part, self._chosen), self._base(q))

    def pose(self, q: Tensor, L0: Tensor, X_tilde: Tensor, j: Tensor) -> Tensor:
        """Poses (..., k, 4, 4) of material points; see `KinematicModel.pose`."""
        batch = self._check_points(q, L0, X_tilde, j)
        k, n_b, rods = X_tilde.shape[-1], self.n_sections, self.rods
        a = _lengthened(self._own(q), L0)
        c = a.shape[-1]
        index = j.expand(*batch, k)[..., None, None]
        own = torch.gather(a.expand(*batch, n_b, c), -2, index[..., 0].expand(*batch, k, c))
        part = self._parts(X_tilde)
        own = own * X_tilde.unsqueeze(-1) if part is None else (part @ own.unsqueeze(-1)).squeeze(-1)
        # Frames at the sections' bases, then the rods of each point's own part.
        rotations, steps = rod_poses(self._twists(a)[0].flatten(-3, -2))
        rotation, position = self._base(q), torch.zeros_like(steps[..., 0, :])
        bases, starts = [], []
        for i in range(n_b * rods):
            if i % rods == 0:
                bases.append(rotation.expand(*position.shape[:-1], 3, 3))
                starts.append(position)
            position = position + (rotation @ steps[..., i, :, None]).squeeze(-1)
            rotation = rotation @ rotations[..., i, :, :]
        before = torch.stack(bases, dim=-3).expand(*batch, n_b, 3, 3)
        rotation = torch.gather(before, -3, index.expand(*batch, k, 3, 3))
        position = torch.gather(
            torch.stack(starts, dim=-2).expand(*batch, n_b, 3), -2, index[..., 0].expand(*batch, k, 3)
        )
        rotations, steps = rod_poses(self._twists(own)[0])
        for i in range(rods):
            position = position + (rotation @ steps[..., i, :, None]).squeeze(-1)
            rotation = rotation @ rotations[..., i, :, :]
        return se3.pose(rotation, position)

    def second_order(
        self, q: Tensor, L0: Tensor, points: MaterialPoints, chain: StrainChain, gradient: Tensor, slope: Tensor
    ) -> PointDerivatives:
        """See `KinematicModel.second_order`."""
        of_parts, part = chain.second_order(gradient, slope), chain.twists.part
        assert part is not None  # of chains to points
        c = part.shape[-1]

        def chosen(rows: Tensor) -> Tensor:
            return rows if self.places is None else rows.index_select(-2, self.places)

        def pulled(columns: Tensor) -> Tensor:
            """P^T columns (..., k, n, r) of columns (..., k, n_b c, r)."""
            return chosen((part.mT @ columns.unflatten(-2, (-1, c))).flatten(-3, -2))

        # P(s) changes by P' in the point's own section.
        rate = torch.eye(c, dtype=q.dtype, device=q.device)
        if self.part_second is not None:
            rate = self.part_first.to(q) + 2.0 * points.fraction[..., None, None] * self.part_second.to(q)
        rate = points.own[..., None, None] * rate
        moved = (rate @ _lengthened(self._own(q), L0)[..., None, :, :, None]).flatten(-3, -2)
        along = (rate.mT @ of_parts.gradient.unflatten(-1, (-1, c)).unsqueeze(-1)).flatten(-3, -2)
        slide = pulled(of_parts.hessian @ moved) + chosen(along)
        hessian = pulled(pulled(of_parts.hessian).mT)
        return PointDerivatives(pulled(of_parts.gradient.unsqueeze(-1)).squeeze(-1), hessian, slide.squeeze(-1))

    def strain(self, q: Tensor, L0: Tensor, points: MaterialPoints) -> Tensor:
        """The strain (..., k, 6) of the points' own sections there."""
        a = _lengthened(self._own(q), L0)
        index = points.section.unsqueeze(-1)
        a = torch.gather(a, -2, index.expand(*points.section.shape, a.shape[-1]))
        strain = a @ self.strain_start.to(a).mT
        if self.strain_slope is None:
            return strain
        return strain + torch.gather(points.fraction, -1, index) * (a @ self.strain_slope.to(a).mT)

    def section_lengths(self, q: Tensor, L0: Tensor) -> Tensor:
        """Lengths (..., n_b) of the sections' curves, m; a basis has the same stretch and shear all along a section."""
        return (_lengthened(self._own(q), L0) @ self.strain_start.to(q)[3:].mT).norm(dim=-1)

    def tendon_matrix(self, routing: TendonRouting, pi_hat: Tensor) -> Tensor:
        """B(pi_hat) (..., n, n_a): the strain's integral between a tendon's ends, as far as it changes its length.

        A tendon beside the backbone, parallel to it, feels bends and stretch. Torsion and shear turn it across its own
        direction, which its length does not feel to first order: their rows are zero.
        """
        begin, end = routing.limits(pi_hat)
        x, y = routing.offsets * torch.cos(routing.angles), routing.offsets * torch.sin(routing.angles)
        zero = torch.zeros_like(x)
        felt = torch.stack((y, -x, zero, zero, zero, torch.ones_like(zero)), dim=-2).unsqueeze(-3)  # (..., 1, 6, n_a)
        rows = (end - begin).unsqueeze(-2) * (self.strain_start.to(felt).mT @ felt)
        if self.strain_slope is not None:
            rows = rows + 0.5 * (end * end - begin * begin).unsqueeze(-2) * (self.strain_slope.to(felt).mT @ felt)
        B = rows.flatten(-3, -2)
        return B if self.places is None else B.index_select(-2, self.places)


def _lengthened(a: Tensor, length: Tensor) -> Tensor:
    """Coordinates (..., c) whose last, delta L, becomes the length: plus length (...), m."""
    return a + torch.nn.functional.pad(length.unsqueeze(-1), (a.shape[-1] - 1, 0))


def _bracket(x: Tensor, y: Tensor) -> Tensor:
    """(6, c, c) Lie bracket [X a, Y b] of twists as a bilinear form of a and b, for X, Y (6, c)."""
    w, v = x.split(3)
    u, t = y.split(3)

    def cross(p: Tensor, q: Tensor) -> Tensor:
        return torch.linalg.cross(p.unsqueeze(-1), q.unsqueeze(-2), dim=0)

    return torch.cat((cross(w, u), cross(w, t) + cross(v, u)))
