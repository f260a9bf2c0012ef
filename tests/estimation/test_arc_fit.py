"""Arcs along a curve: `ArcFit` against a general least-squares solver, and on curves that arcs can be."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from apcc_torch import AffineBackbone, PCCBackbone
from apcc_torch.estimation.arc_fit import ArcFit
from apcc_torch.model.kinematic_model import KinematicModel
from arms import HANGING_BASE

D = torch.float64
N = 12
SHARE = torch.arange(1, N + 1, dtype=D) / N
L0 = torch.tensor([0.105, 0.255, 0.24], dtype=D)
MODELS = {"pcc": PCCBackbone(3, HANGING_BASE), "affine": AffineBackbone(3, HANGING_BASE)}


def fitted(fit: ArcFit, points: Tensor, pi_hat: Tensor, steps: int = 60) -> Tensor:
    q = torch.zeros(*points.shape[:-2], fit.backbone.n, dtype=D)
    pi_hat, share = pi_hat.expand(*q.shape[:-1], 3), SHARE.expand(*q.shape[:-1], N)
    for _ in range(steps):
        q = fit(q, pi_hat, points, share)
    return q


def curve(model: KinematicModel, lengths: Tensor, seed: int, bend: float = 0.8) -> tuple[Tensor, Tensor]:
    """A model's own curve: q with nothing but bends, and points at even shares of its length."""
    draw = torch.Generator().manual_seed(seed)
    n_b = lengths.shape[-1]
    x, y = bend * (2.0 * torch.rand(2, 4, n_b, generator=draw, dtype=D) - 1.0)
    q = model.coordinates.from_bends(x, y)
    return q, model.points(q, lengths, N + 1)[..., 1:, :]


@pytest.mark.parametrize("name", MODELS)
def test_its_own_curve_is_found_whatever_the_rest_lengths_are(name: str) -> None:
    model = MODELS[name]
    q, points = curve(model, L0, 0)
    for factor in (torch.ones(3, dtype=D), torch.tensor([1.2, 0.8, 1.1], dtype=D)):
        found = fitted(ArcFit(model, L0), points, factor * L0)
        places = model.coordinates.elongations
        assert (factor * L0 + found[..., places] - L0).abs().max() < 2e-4
        angles = torch.ones(model.n, dtype=torch.bool)
        angles[places] = False
        assert (found - q)[..., angles].abs().max() < 2e-2
        assert (model.points(found, factor * L0, N + 1)[..., 1:, :] - points).norm(dim=-1).max() < 2e-4


def test_other_sections_than_the_nominal_ones_are_found() -> None:
    model, lengths = MODELS["pcc"], torch.tensor([0.16, 0.21, 0.23], dtype=D)
    _, points = curve(model, lengths, 1, bend=1.2)
    found = fitted(ArcFit(model, L0, curve_noise=1e-5), points, L0, steps=200)
    assert (model.points(found, L0, N + 1)[..., 1:, :] - points).norm(dim=-1).max() < 5e-4
    assert (L0 + found[..., 2::3] - lengths).abs().max() < 5e-3


def unlikely(ratio: Tensor) -> Tensor:
    """c of the class's description, written otherwise: how many times as long or as short, less one, with its sign."""
    return torch.sign(ratio.log()) * (ratio.log().abs().exp() - 1.0)


@pytest.mark.parametrize("factor", [0.4, 0.8, 1.5, 2.0])
def test_half_as_long_is_as_unlikely_as_twice_as_long(factor: float) -> None:
    """Of a straight curve that tells next to nothing, a step is Newton's down what the lengths cost."""
    model = MODELS["pcc"]
    start = model.coordinates.with_elongations(torch.zeros(9, dtype=D), (factor - 1.0) * L0)
    fit, points = ArcFit(model, L0, curve_noise=1e6, length_prior=0.3), model.points(start, L0, N + 1)[1:]
    ratio = torch.tensor(factor, dtype=D, requires_grad=True)
    (slope,) = torch.autograd.grad(unlikely(ratio).square(), ratio, create_graph=True)
    (bend,) = torch.autograd.grad(slope, ratio)
    want = -(slope / bend).detach() * L0
    torch.testing.assert_close(fit(start, L0, points, SHARE)[2::3] - start[2::3], want, rtol=1e-3, atol=1e-9)


def test_it_ends_at_the_least_of_its_cost() -> None:
    """Of a curve that no three arcs are: six of another arm, whose lengths are drawn to the nominal ones."""
    fine, pieces = PCCBackbone(6, HANGING_BASE), L0.repeat_interleave(2) / 2.0
    _, points = curve(fine, pieces, 2, bend=0.4)
    model, fit = MODELS["pcc"], ArcFit(MODELS["pcc"], L0)

    def residual(z: np.ndarray, target: Tensor) -> np.ndarray:
        """Written out from the class's description, on points found by length along the model."""
        q = torch.from_numpy(z)
        lengths = L0 + q[2::3]
        ends = lengths.cumsum(0)
        along = SHARE * ends[-1]
        j = torch.searchsorted(ends, along.contiguous()).clamp(max=2)
        X_tilde = ((along - ends[j] + lengths[j]) / lengths[j]).clamp(max=1.0)
        off = target - model.pose(q, L0, X_tilde, j)[:, :3, 3]
        return torch.cat((off.flatten() / (1.5e-4 * 0.6 * N**0.5), unlikely(lengths / L0) / 0.2)).numpy()

    for target in points:
        start = fitted(fit, target, L0, steps=100)
        ours = np.square(residual(start.numpy(), target)).sum()
        best = min(
            least_squares(residual, at, args=(target,), method="lm").cost * 2.0 for at in (start.numpy(), np.zeros(9))
        )
        assert ours < 1.05 * best + 1e-9


def test_no_arc_loses_its_length_and_a_row_that_is_not_finite_stays() -> None:
    fit = ArcFit(MODELS["pcc"], L0)
    points = torch.zeros(2, N, 3, dtype=D)  # a curve of no length at all
    points[1] = torch.nan
    found = fitted(fit, points, L0)
    assert bool((L0 + found[0, 2::3] >= 0.05 * L0 - 1e-12).all())
    assert torch.equal(found[1], torch.zeros(9, dtype=D))


def test_it_does_not_amplify_rounding_on_a_far_arm_s_way() -> None:
    """The true arm of section V-B under 0.5 kg, on its last two seconds to the paper's set-point."""
    pieces = L0.repeat_interleave(2) / 2.0
    bends = [[0.1473, 0.2184, -0.0146, 0.9784, 0.135, 1.3792], [0.1477, 0.2227, -0.0149, 1.0128, 0.1572, 1.3981]]
    long = [[0.0011, -0.0055, 0.0283, -0.032, 0.0256, -0.0248], [0.0032, -0.0035, 0.0314, -0.0309, 0.0253, -0.0241]]
    fine, model = PCCBackbone(6, HANGING_BASE), MODELS["pcc"]
    ways = (torch.tensor(each, dtype=D) for each in (bends, long))
    x, dL = (torch.lerp(each[0], each[1], torch.linspace(0, 1, 200, dtype=D).unsqueeze(-1)) for each in ways)
    q = torch.stack((x, torch.zeros_like(x), dL), dim=-1).flatten(-2)
    lengths = pieces + dL
    along = lengths.cumsum(-1).unsqueeze(-1) - lengths.unsqueeze(-1) * torch.tensor([0.5, 0.0], dtype=D)
    share = along.flatten(-2) / lengths.sum(-1, keepdim=True)
    X_tilde, j = torch.tensor([0.5, 1.0], dtype=D).repeat(6), torch.arange(6).repeat_interleave(2)
    points = fine.pose(q, pieces, X_tilde, j)[..., :3, 3]
    pi_hat = torch.tensor([0.2169, 0.3172, 0.0565], dtype=D)
    fit = ArcFit(model, L0)
    found = model.coordinates.from_bends(torch.tensor([0.4661, 1.4148, 1.0051], dtype=D), torch.zeros(3, dtype=D))
    for _ in range(60):
        found = fit(found, pi_hat, points[0], share[0])
    # The first row as it is, each other one off by as much in one coordinate: what became of that, of any direction.
    found, growth = torch.cat((found.unsqueeze(0), found + 1e-9 * torch.eye(9, dtype=D))), []
    for target, at in zip(points, share, strict=True):
        found = fit(found, pi_hat.expand(10, 3), target.expand(10, N, 3), at.expand(10, N))
        growth.append(torch.linalg.matrix_norm((found[1:] - found[0]) / 1e-9, ord=2))
    assert max(growth) < 10.0
    assert growth[20] < 1e-2
