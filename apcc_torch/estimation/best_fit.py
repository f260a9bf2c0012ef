"""The limit: the best that a model's sections can do on a shape that is known, as no controller knows it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.linalg import solve_spd
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.modes import full_precision
from apcc_torch.shapes import broadcast, check_tensor

_SHORTEST = 1e-4  # m; a section squeezed to nothing keeps this much, so that its neighbours stay finite


class BestFit(NamedTuple):
    """The best fit of each row.

    q: (..., n) configuration. pi: (..., n_b) rest lengths, m. error: (...) m, mean distance, Eq. (52).
    """

    q: Tensor
    pi: Tensor
    error: Tensor


@full_precision
def best_fit(
    model: KinematicModel,
    points: Tensor,
    q: Tensor,
    pi: Tensor,
    free_lengths: bool = False,
    spacing: str = "arc",
    iterations: int = 40,
) -> BestFit:
    """The q, or the (q, pi), whose backbone has the least mean distance, Eq. (52), to known points, offline.

    Levenberg-Marquardt on reweighted squares: the weights 1 / distance of the last iterate turn the sum of squares into
    the sum of distances. With points evenly along the curve ("arc") a section's rest length and elongation are one
    number to a shape, so freeing pi changes nothing; with material points it does.

    Args:
        model: The sections to fit.
        points: (..., N, 3) the true backbone from base to tip, spaced as `spacing` says, m.
        q: (..., n) first guess.
        pi: (..., n_b) rest lengths, the first guess where they are free, m.
        free_lengths: Whether to fit pi too.
        spacing: "arc" or "material", see `KinematicModel.points`.
        iterations: Steps.

    Raises:
        ShapeError, DtypeError: The arguments do not fit each other.
        ValueRangeError: iterations < 1, or an unknown spacing.

    Example:
        >>> six, three, L0 = PCCBackbone(6), PCCBackbone(3), torch.full((6,), 0.1).double()
        >>> points = six.points(0.2 * torch.tensor([1.0, 0.0, 0.0, -1.0, 0.0, 0.0] * 3).double(), L0, 61)
        >>> best_fit(three, points, torch.zeros(9).double(), 2.0 * L0[:3]).error
        tensor(0.0014, dtype=torch.float64)
    """
    model.check(q, pi)
    check_tensor("points", points, (None, 3))
    if points.shape[-2] < 2:
        raise ShapeError(f"points must have at least 2 points, got {points.shape[-2]}")
    if spacing not in ("arc", "material"):
        raise ValueRangeError(f"spacing must be arc or material, got {spacing!r}")
    if iterations < 1:
        raise ValueRangeError(f"iterations must be at least 1, got {iterations}")
    batch = broadcast(points.shape[:-2], q.shape[:-1], pi.shape[:-1])
    q, pi = q.expand(*batch, q.shape[-1]), pi.expand(*batch, pi.shape[-1])
    N = points.shape[-2]

    best_q, best_pi = q, pi
    placed, columns = _curve(model, q, pi, N, spacing, free_lengths)
    offset = points - placed
    best = offset.norm(dim=-1).mean(-1)
    damping = torch.full_like(best, 1e-3)
    for _ in range(iterations):
        # A distance of a hundredth of the mean weighs no more than that: the minimum has points with none.
        distance = offset.norm(dim=-1, keepdim=True)
        weight = torch.maximum(distance, 0.01 * best[..., None, None] + 1e-12).rsqrt()
        A = (columns * weight.unsqueeze(-1)).flatten(-3, -2)
        r = (offset * weight).flatten(-2).unsqueeze(-1)
        H = A.mT @ A
        scale = H.diagonal(dim1=-2, dim2=-1) + 1e-9 * H.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True)
        step = solve_spd(H + torch.diag_embed(damping.unsqueeze(-1) * scale), A.mT @ r).squeeze(-1)
        q, pi = best_q + step[..., : model.n], best_pi
        if free_lengths:
            pi = (pi + step[..., model.n :]).clamp(min=_SHORTEST)
        placed, moved = _curve(model, q, pi, N, spacing, free_lengths)
        missed = points - placed
        error = missed.norm(dim=-1).mean(-1)
        better = error < best
        best_q, best_pi = (torch.where(better.unsqueeze(-1), new, old) for new, old in ((q, best_q), (pi, best_pi)))
        offset = torch.where(better[..., None, None], missed, offset)
        columns = torch.where(better[..., None, None, None], moved, columns)
        best = torch.where(better, error, best)
        damping = torch.where(better, 0.3 * damping, 4.0 * damping).clamp(1e-9, 1e9)
    return BestFit(best_q, best_pi, best)


def _curve(
    model: KinematicModel, q: Tensor, pi: Tensor, N: int, spacing: str, free_lengths: bool
) -> tuple[Tensor, Tensor]:
    """`KinematicModel.points` (..., N, 3) and its derivative (..., N, 3, n) with respect to q, or q and pi."""
    share = torch.linspace(0.0, 1.0, N, dtype=q.dtype, device=q.device)
    length, elongations = model.section_lengths(q, pi).clamp(min=_SHORTEST), model.coordinates.elongations
    measure = pi if spacing == "material" else length
    X_tilde, j = decouple(share * measure.sum(-1, keepdim=True), measure)
    points = model.material_points(pi, X_tilde, j)
    chain = model.chain_to(q, points)
    J = chain.rotation @ chain.body_jacobian()[..., 3:, :]
    # With its part of its section fixed, a point goes where J says. To keep its share of the whole it also slides along
    # the curve: u of what the whole gains, less what the sections before it and its own part gain.
    tangent = chain.rotation[..., :, 2:]
    slide = tangent * (share.unsqueeze(-1) - points.fraction).unsqueeze(-2)
    if spacing == "arc":
        along = torch.zeros_like(J)
        along[..., elongations] = slide
        J = J + along
        return chain.tip, torch.cat((J, J[..., elongations]), dim=-1) if free_lengths else J
    if not free_lengths:
        return chain.tip, J
    stretch = torch.gather(length / pi, -1, j)[..., None, None]
    return chain.tip, torch.cat((J, J[..., elongations] + slide * stretch), dim=-1)
