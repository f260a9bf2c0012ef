"""How well the arcs' lengths are known: against shapes drawn at random, against slopes by differences, row by row."""

from __future__ import annotations

import pytest
import torch
from shape_covariance import ARMS, covered
from torch import Tensor

from apcc_torch import Arm
from apcc_torch.estimation.length_covariance import length_covariance
from apcc_torch.estimation.shape_feedback import FollowedShape, ShapeFeedback, ShapeFeedbackSettings

D = torch.float64
ARM = Arm(lengths=[0.15, 0.2], mass=0.3)
BENDS = torch.tensor([[0.6, 0.1, 0.003, -0.3, 0.4, 0.0], [0.2, -0.5, 0.0, 0.4, 0.3, 0.002]], dtype=D)


def settled(feedback: ShapeFeedback, q: Tensor) -> tuple[FollowedShape, Tensor, Tensor]:
    """A shape that sags within its sections, the arcs at rest along it, and their rest lengths."""
    pi = ARM.rest_lengths().to(q).expand(len(q), -1)
    state = feedback.initial_state(q, pi)
    state = moved(feedback, state, torch.zeros(7, dtype=D).to(q))
    return state, fitted(feedback, state, q, pi), pi


def fitted(feedback: ShapeFeedback, state: FollowedShape, q: Tensor, pi: Tensor) -> Tensor:
    points, share = feedback.curve(state.shape)
    for _ in range(60):
        q = feedback.fit(q, pi, points, share)
    return q


def scatter(rows: int, scale: float) -> Tensor:
    """Covariances (rows, 7, 7) of six strains and a load."""
    A = torch.randn(rows, 7, 7, generator=torch.Generator().manual_seed(2), dtype=D)
    return scale**2 * (A @ A.mT + 0.1 * torch.eye(7, dtype=D))


def moved(feedback: ShapeFeedback, state: FollowedShape, away: Tensor) -> FollowedShape:
    """The arm at rest with other strains and another load: its sag is that of its shape."""
    shape = state.shape
    sections, load = shape.sections + away[..., :-1], shape.load + away[..., -1]
    shape = shape._replace(sections=sections, load=load, sag=shape.sag.expand(*load.shape, *shape.sag.shape[-2:]))
    for _ in range(60):
        shape = shape._replace(sag=feedback.shape.renewed(shape, torch.full_like(shape.load, torch.inf)))
    return state._replace(shape=shape)


def test_of_little_scatter_it_is_that_of_the_slopes() -> None:
    feedback = ShapeFeedback.on(ARM, ARM.backbone(), ShapeFeedbackSettings())
    state, q, pi = settled(feedback, BENDS)
    P, step = scatter(2, 1e-6), 1e-5
    columns = []
    for direction in step * torch.eye(7, dtype=D):
        ahead, behind = (
            fitted(feedback, moved(feedback, state, way * direction), q, pi)[:, 2::3] for way in (1.0, -1.0)
        )
        columns.append((ahead - behind) / (2.0 * step))
    J = torch.stack(columns, -1)
    found = length_covariance(feedback, state, q, pi, P)
    torch.testing.assert_close(found, J @ P @ J.mT, rtol=2e-2, atol=1e-3 * float(found.abs().max()))


def test_of_more_it_is_how_far_the_lengths_of_random_shapes_are() -> None:
    feedback = ShapeFeedback.on(ARM, ARM.backbone(), ShapeFeedbackSettings())
    state, q, pi = settled(feedback, BENDS[:1])
    P, count = scatter(1, 8e-3), 2000
    drawn = torch.randn(count, 7, generator=torch.Generator().manual_seed(3), dtype=D) @ torch.linalg.cholesky(P[0]).mT
    every = FollowedShape(
        type(state.shape)(*(each.expand(count, *each.shape[1:]) for each in state.shape)),
        state.lengths.expand(count, -1),
        state.tip.expand(count, -1),
    )
    tried = fitted(feedback, moved(feedback, every, drawn), q.expand(count, -1), pi.expand(count, -1))
    off = (tried - q)[:, 2::3]
    found = length_covariance(feedback, state, q, pi, P)[0]
    assert float((found / (off.mT @ off / count)).diagonal().log().abs().max()) < 0.2


def test_rows_do_not_meet_and_single_precision_agrees() -> None:
    feedback = ShapeFeedback.on(ARM, ARM.backbone(), ShapeFeedbackSettings())
    state, q, pi = settled(feedback, BENDS)
    P = scatter(2, 3e-3)
    both = length_covariance(feedback, state, q, pi, P)
    for row in range(2):
        one = slice(row, row + 1)
        shape = type(state.shape)(*(each[one] for each in state.shape))
        alone = FollowedShape(shape, state.lengths[one], state.tip[one])
        torch.testing.assert_close(length_covariance(feedback, alone, q[one], pi[one], P[one]), both[one])
    for wrong in (torch.nan, -1.0):
        beside = length_covariance(feedback, state, q, pi, torch.stack((P[0], wrong * torch.eye(7, dtype=D))))
        assert torch.equal(beside[0], both[0]) and bool(beside[1].isnan().all())
    torch.testing.assert_close(both, both.mT)
    assert bool((torch.linalg.eigvalsh(both) > 0.0).all())
    single = ShapeFeedback.on(ARM, ARM.backbone(), ShapeFeedbackSettings()).float()
    less = FollowedShape(
        type(state.shape)(*(each.float() for each in state.shape)), state.lengths.float(), state.tip.float()
    )
    found = length_covariance(single, less, q.float(), pi.float(), P.float())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), both, rtol=3e-2, atol=1e-3 * float(both.max()))


@pytest.mark.parametrize("name", ["three sections", "two sensors"])
def test_lengths_scatter_by_it(name: str) -> None:
    # Known no better than it is, the shape does not make the fit jump from valley to valley.
    found = covered(ARMS[name], ShapeFeedbackSettings(curve_noise=1e-3), rows=150, steps=50)
    # Of a length that is no linear function of the shape it errs to the safe side.
    assert 0.5 < found.lengths < 1.0 + found.band
