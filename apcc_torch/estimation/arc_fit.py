"""The model's configuration that runs along an estimated shape: arcs fitted to a curve, their lengths free."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.linalg import scaled_within, solve_spd
from apcc_torch.model.abscissae import located
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import OURS, Setting, Settings, aligned, resolved, setting
from apcc_torch.shapes import check_finite, check_tensor

DAMPING = 1e-4
"""Of a step, over the diagonal of its normal matrix."""
LARGEST_STEP = 0.3
"""Largest change of a coordinate in one step, rad and m."""
NEAR = 0.02
"""Over the arm's length, how far off a point may be for a step to see the backbone turn; much farther it misleads."""
SHORTEST = 0.05
"""Of its nominal length, the least that an arc keeps."""


@dataclass(frozen=True, kw_only=True)
class ArcFitSettings(Settings):
    """Settings of `ArcFit`."""

    curve_noise: Setting = setting(
        1.5e-4,
        "",
        OURS,
        "how well the shape is known over the arm's length, a standard deviation",
        rows="number",
        above=0,
    )
    length_prior: Setting = setting(
        0.2, "", OURS, "how well a section's length is, over itself, likewise", rows="number", above=0
    )


class ArcFit(Part):
    """Fits a model to points of a curve: sections l_i = pi_i + dL_i whose lengths are drawn to the nominal ones,

        V(q) = sum |p_j - x_j|^2 / (N (sigma L)^2) + sum (c(l_i / L_i) / rho)^2,  L = sum L_i,
        c(r) = r - 1 above 1, 1 - 1 / r below:  twice as long is as unlikely as half as long,

    p_j the N points and x_j the model's points that lie as far along it, over its length: the distances of Eq. (52)
    [Dalenberg]. How the curve is stretched does not matter. l alone counts: how much of it is rest length and how much
    elongation, shape does not tell. To lose its length costs a section infinitely much, so the shape can count for far
    more than the nominal lengths. A section that grows slides all points along the backbone; a step that leaves this
    out does not lead down V.

    Args:
        backbone: The model.
        nominal: (..., n_b) L, m.
        *settings, **changes: See `ArcFitSettings`.

    Raises:
        ValueRangeError: A setting is out of range.

    Example:
        >>> backbone, L0 = PCCBackbone(1), torch.tensor([0.2]).double()
        >>> q, share = torch.tensor([0.4, 0.0, 0.0]).double(), torch.linspace(0.25, 1.0, 4).double()
        >>> points = backbone.points(q, L0, 5)[1:]
        >>> fit, found = ArcFit(backbone, L0), torch.zeros(3).double()
        >>> for _ in range(5):
        ...     found = fit(found, L0, points, share)
        >>> found.round(decimals=3) + 0.0
        tensor([0.4000, 0.0000, 0.0000], dtype=torch.float64)
    """

    settings_type = ArcFitSettings
    nominal: Tensor
    curve_noise: Setting
    length_prior: Setting

    def __init__(self, backbone: KinematicModel, nominal: Tensor, *settings: Any, **changes: Any) -> None:
        super().__init__()
        check_finite("nominal", check_tensor("nominal", nominal, (None,)))
        self.backbone = backbone
        hold_rows(self, nominal=(nominal, 1))
        self.hold(resolved(ArcFitSettings, settings, changes))

    def forward(self, q: Tensor, pi_hat: Tensor, points: Tensor, share: Tensor) -> Tensor:
        """One step: q (..., n) nearer to the points; unchecked, of one leading shape.

        Gauss and Newton's of the distances, Newton's own of what the lengths cost.

        Args:
            q: (..., n) the last fit.
            pi_hat: (..., n_b) rest lengths, m.
            points: (..., N, 3) of the curve, m, the last one its tip.
            share: (..., N) how far along the curve each point is, over its length.
        """
        backbone = self.backbone
        nominal = self.nominal.to(q)
        lengths = torch.maximum(backbone.section_lengths(q, pi_hat), SHORTEST * nominal)
        at = backbone.material_points(pi_hat, *located(share * lengths.sum(-1, keepdim=True), lengths))
        chain = backbone.chain_to(q, at)
        N = share.shape[-1]
        weight = 1.0 / (aligned(self.curve_noise, 0) * nominal.sum(-1) * N**0.5)[..., None]
        off = chain.rotation.mT @ (points - chain.tip).unsqueeze(-1)
        turning, moving = chain.body_jacobian().split(3, dim=-2)
        r = off.squeeze(-1).flatten(-2) * weight
        # d(R^T (p_j - p)) = -(moving - off x turning) dq
        near = NEAR * nominal.sum(-1)[..., None, None, None]
        seen = off * near / torch.sqrt(near**2 + off.square().sum(-2, keepdim=True))
        closing = moving - torch.linalg.cross(seen.expand_as(turning), turning, dim=-2)
        # In a point's own axes the backbone runs along z.
        slide = backbone.coordinates.on_elongations(share.unsqueeze(-1) - at.fraction).unsqueeze(-2)
        closing = closing + torch.cat((torch.zeros_like(slide), torch.zeros_like(slide), slide), dim=-2)
        J = closing.flatten(-3, -2) * weight.unsqueeze(-1)
        ratio, loose = lengths / nominal, aligned(self.length_prior, 1) * nominal
        short = ratio.reciprocal()
        # (c^2)' / 2 and (c^2)'' / 2, c'' too: of a short section it is most, and a step without it overshoots.
        slope = torch.where(ratio > 1.0, ratio - 1.0, (1.0 - short) * short.square()) * nominal / loose.square()
        bend = torch.where(ratio > 1.0, 1.0, (3.0 * short - 2.0) * short**3) / loose.square()
        H = J.mT @ J + torch.diag_embed(backbone.coordinates.on_elongations(bend))
        H = H + DAMPING * torch.diag_embed(H.diagonal(dim1=-2, dim2=-1))
        g = (J.mT @ r.unsqueeze(-1)).squeeze(-1) - backbone.coordinates.on_elongations(slope)
        step = solve_spd(H, g.unsqueeze(-1)).squeeze(-1)
        step = scaled_within(step, LARGEST_STEP)
        moved = q + torch.where(torch.isfinite(step).all(-1, keepdim=True), step, 0.0)
        free = torch.full_like(moved, -torch.inf)
        return torch.maximum(moved, backbone.coordinates.with_elongations(free, SHORTEST * nominal - pi_hat))
