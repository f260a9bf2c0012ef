"""Tendon routing over constant-curvature sections: actuation matrix B(pi_hat) and tendon lengths, Eqs. (42)-(49).

y is the change of a tendon's length along its path (y = B^T q) and u is the force conjugate to it, so the generalized
force is tau = B u and the tension of a tendon is -u.
"""

from __future__ import annotations

from math import pi

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ShapeError
from apcc_torch.model.abscissae import whole
from apcc_torch.part import Part, hold_rows, refuse_parameter
from apcc_torch.shapes import check_finite, check_positive, check_same, check_tensor


class TendonRouting(Part):
    """Tendons parallel to the backbone, each fixed at its anchor's material abscissa.

    In the coupled layout a tendon runs from the arm's base to its anchor. In the independent layout it acts only from
    its start, the abscissa of the previous rack, to its anchor (a sheath carries it up to there).

    Args:
        angles: (n_a,) angle of each tendon around the backbone from the section's x axis, rad.
        offsets: (n_a,) distance from the backbone, m.
        anchors: (..., n_a) material abscissa where each tendon ends, m.
        layout: "coupled" or "independent".
        starts: (..., n_a) material abscissa where each tendon begins to act, m. None: zero in the coupled layout, the
            largest smaller anchor (or zero) in the independent one.

    Raises:
        ConfigError: `layout` is unknown.
        ShapeError: The four tensors differ in length.
        ValueRangeError: An offset or anchor is not positive.

    Example:
        >>> routing = TendonRouting(torch.tensor([0.0, pi]), torch.tensor([0.02, 0.02]), torch.tensor([0.2, 0.45]))
        >>> routing.lengths(torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0, 0.01]), torch.tensor([0.2, 0.25]))
        tensor([-0.0100,  0.0200])
    """

    angles: Tensor
    offsets: Tensor
    anchors: Tensor
    starts: Tensor

    def __init__(
        self, angles: Tensor, offsets: Tensor, anchors: Tensor, layout: str = "coupled", starts: Tensor | None = None
    ) -> None:
        super().__init__()
        if layout not in ("coupled", "independent"):
            raise ConfigError(f"layout must be 'coupled' or 'independent', got {layout!r}")
        check_finite("angles", check_tensor("angles", angles, (None,)))
        n_a = angles.shape[-1]
        check_positive("offsets", check_tensor("offsets", offsets, (n_a,)))
        check_positive("anchors", check_tensor("anchors", anchors, (n_a,)))
        if starts is None:
            starts = torch.zeros_like(anchors)
            if layout == "independent":
                refuse_parameter("anchors", anchors, "the starts are made of them once; hand in starts too")
                smaller = torch.where(anchors.unsqueeze(-2) < anchors.unsqueeze(-1), anchors.unsqueeze(-2), 0.0)
                starts = smaller.amax(-1)
        check_finite("starts", check_tensor("starts", starts, (n_a,)))
        check_same(angles=angles, offsets=offsets, anchors=anchors, starts=starts)
        if angles.dim() != 1:
            raise ShapeError(f"angles must have shape ({n_a},), got {tuple(angles.shape)}")
        self.layout = layout
        self.n_tendons = n_a
        hold_rows(self, angles=(angles, 1), offsets=(offsets, 1), anchors=(anchors, 1), starts=(starts, 1))

    def limits(self, pi_hat: Tensor) -> tuple[Tensor, Tensor]:
        """Where in each section each tendon begins and ends: normalised abscissae (..., n_b, n_a), those of Eq. (46).

        An anchor beyond the arm's total length is held at the tip (remark 3). Between crossings of a section boundary
        the result is differentiable in `pi_hat`.

        Args:
            pi_hat: (..., n_b) section lengths, m.
        """
        check_tensor("pi_hat", pi_hat, (None,))
        check_same(pi_hat=pi_hat, anchors=self.anchors)
        begin = (torch.cumsum(pi_hat, dim=-1) - pi_hat).unsqueeze(-1)
        length = pi_hat.unsqueeze(-1)
        reached = ((self.anchors.unsqueeze(-2) - begin) / length).clamp(0.0, 1.0)
        return whole(((self.starts.unsqueeze(-2) - begin) / length).clamp(0.0, 1.0)), whole(reached)

    def fractions(self, pi_hat: Tensor) -> Tensor:
        """Share of each section that each tendon traverses (..., n_b, n_a), in [0, 1]; see `limits`."""
        begin, end = self.limits(pi_hat)
        return end - begin

    def matrix(self, pi_hat: Tensor) -> Tensor:
        """Actuation matrix B(pi_hat) (..., 3 n_b, n_a), Eqs. (42)-(46) [Dalenberg].

        Args:
            pi_hat: (..., n_b) section lengths, m.
        """
        # The strain basis of a section is constant, so Eq. (46) is the traversed fraction of the full section's row.
        rows = full_rows(self.angles, self.offsets).unsqueeze(-3)
        return (self.fractions(pi_hat).unsqueeze(-2) * rows).flatten(-3, -2)

    def lengths(self, q: Tensor, pi_hat: Tensor) -> Tensor:
        """Tendon length changes y = B^T q (..., n_a), m, Eq. (49) [Dalenberg].

        Args:
            q: (..., 3 n_b) rad, rad, m.
            pi_hat: (..., n_b) section lengths, m.
        """
        check_tensor("q", q, (3 * check_tensor("pi_hat", pi_hat, (None,)).shape[-1],))
        check_same(q=q, pi_hat=pi_hat)
        # Eq. (49)
        return (self.matrix(pi_hat).mT @ q.unsqueeze(-1)).squeeze(-1)

    def generalized_force(self, u: Tensor, pi_hat: Tensor) -> Tensor:
        """tau = B u (..., 3 n_b), Eq. (34) [Dalenberg].

        Args:
            u: (..., n_a) forces conjugate to the tendon lengths, N; tension is -u.
            pi_hat: (..., n_b) section lengths, m.
        """
        check_tensor("u", u, (self.n_tendons,))
        check_tensor("pi_hat", pi_hat, (None,))
        check_same(u=u, pi_hat=pi_hat)
        return (self.matrix(pi_hat) @ u.unsqueeze(-1)).squeeze(-1)

    def paths(self, T: Tensor, X: Tensor) -> Tensor:
        """Where the tendons run beside points of the backbone (n_a, P, 3), m, NaN where one does not run.

        Args:
            T: (P, 4, 4) poses of material points, m.
            X: (P,) their abscissae, m.
        """
        angle, offset = self.angles.to(T).unsqueeze(-1), self.offsets.to(T).unsqueeze(-1)
        aside = torch.stack((offset * torch.cos(angle), offset * torch.sin(angle), torch.zeros_like(angle)), dim=-1)
        paths = T[:, :3, 3] + (T[:, :3, :3] @ aside.unsqueeze(-1)).squeeze(-1)
        begin, end = (place.to(X).unsqueeze(-1) for place in (self.starts, self.anchors))
        runs = (begin - 1e-6 <= X) & (end + 1e-6 >= X)
        return torch.where(runs.unsqueeze(-1), paths, torch.nan)


def full_rows(angles: Tensor, offsets: Tensor) -> Tensor:
    """Rows (..., 3, n_a) of B that a fully traversed section has on (dx, dy, dL), Eqs. (42)-(45) [Dalenberg].

    Args:
        angles: (..., n_a) angle of each tendon around the backbone, rad.
        offsets: (..., n_a) distance from the backbone, m.
    """
    return torch.stack((-offsets * torch.cos(angles), -offsets * torch.sin(angles), torch.ones_like(offsets)), dim=-2)


def rack_routing(
    racks: Tensor,
    offset: float | Tensor = 0.027,
    per_rack: int = 3,
    twist: float = pi / 6.0,
    layout: str = "coupled",
) -> TendonRouting:
    """Racks of evenly spaced tendons, each rack turned by `twist` relative to the one before.

    The defaults with racks (0.105, 0.36, 0.60) m are the nine tendons of the paper's section V-B.

    Args:
        racks: (..., k) abscissae of the racks, m, increasing.
        offset: Distance of every tendon from the backbone, m.
        per_rack: Tendons per rack, 360/per_rack degrees apart.
        twist: Rotation of each rack relative to the preceding one, rad.
        layout: "coupled" or "independent"; see `TendonRouting`.

    Example:
        >>> routing = rack_routing(torch.tensor([0.2, 0.45]), offset=0.02, per_rack=3)
        >>> routing.n_tendons, routing.anchors
        (6, tensor([0.2000, 0.2000, 0.2000, 0.4500, 0.4500, 0.4500]))
    """
    refuse_parameter("racks", racks, "make a TendonRouting whose anchors are a Parameter")
    refuse_parameter("offset", offset, "make a TendonRouting whose offsets are a Parameter")
    check_positive("racks", check_tensor("racks", racks, (None,)))
    dtype, device = racks.dtype, racks.device
    around = torch.arange(per_rack, dtype=dtype, device=device) * (2.0 * pi / per_rack)
    turned = torch.arange(racks.shape[-1], dtype=dtype, device=device) * twist
    angles = (turned.unsqueeze(-1) + around).flatten()
    return TendonRouting(angles, offset * torch.ones_like(angles), racks.repeat_interleave(per_rack, dim=-1), layout)
