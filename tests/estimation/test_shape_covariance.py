"""The covariance of a shape: as estimates scatter, and as points move."""

from __future__ import annotations

import pytest
import torch
from shape_covariance import ARMS, covered

from apcc_torch import decouple
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.shape_feedback import ShapeFeedbackSettings

D = torch.float64


@pytest.mark.parametrize("name", ["three sections", "two sensors", "four, standing"])
def test_estimates_scatter_by_their_covariance(name: str) -> None:
    found = covered(ARMS[name], ShapeFeedbackSettings(), rows=150, steps=50)
    # Beside chance, which is the band, the arm is no linear function of what is measured.
    assert abs(found.strains - 1.0) < found.band + 0.05
    assert 0.7 < found.load < 1.3 and 0.8 < found.middle < 1.2 and 0.8 < found.tip < 1.2


def test_points_follow_the_strains_and_the_load() -> None:
    """J P J^T with J from differences."""
    arm = ARMS["three sections"]
    shape, lengths, X = LoadedShape.on(arm, LoadedShapeSettings()), arm.rest_lengths(), torch.tensor([0.2, 0.6]).to(D)
    draw = torch.Generator().manual_seed(2)
    state = shape.initial_state(torch.cat([torch.tensor([0.3, -0.4, L], dtype=D) for L in lengths]))
    state = state._replace(load=torch.tensor(0.2, dtype=D), sag=0.02 * torch.randn(2, 18, generator=draw, dtype=D))
    A = 1e-2 * torch.randn(10, 10, generator=draw, dtype=D)
    P = A @ A.mT

    def at(change: torch.Tensor) -> torch.Tensor:
        moved = state._replace(sections=state.sections + change[:-1], load=state.load + change[-1])
        own = shape.dynamics.lengths
        return shape.backbone.pose(shape.configuration(moved), own, *decouple(X, own))[..., :3, 3]

    J = torch.func.jacfwd(at)(torch.zeros(10, dtype=D))
    torch.testing.assert_close(shape.point_covariance(state, P, X), J @ P @ J.mT, rtol=1e-9, atol=1e-15)
