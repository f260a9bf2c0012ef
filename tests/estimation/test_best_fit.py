"""The oracle's fit against arms it can represent, SciPy's minimiser, and its own meaning."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from scipy.optimize import minimize

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.estimation.best_fit import _curve, best_fit
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.simulation.metrics import shape_error
from arms import HANGING_BASE, PI, PI_HAT, configurations
from laws import bits, generator, seeds

MODEL = PCCBackbone(3, HANGING_BASE)
TRUE = PCCBackbone(6, HANGING_BASE)
PLANT = torch.tensor([0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12], dtype=torch.float64)
STRAIGHT = torch.zeros(9, dtype=torch.float64)


@settings(max_examples=5)
@given(seed=seeds)
def test_an_arm_of_the_models_kind_is_found(seed: int) -> None:
    q = configurations((3,), 3, torch.float64, generator(seed), bend=0.5)
    fit = best_fit(MODEL, MODEL.points(q, PI, 30), STRAIGHT, PI_HAT, iterations=100)
    assert fit.error.max() < 1e-6
    # With any rest lengths: the elongations make up for them.
    torch.testing.assert_close((fit.q[:, 2::3] + PI_HAT), q[:, 2::3] + PI, atol=1e-4, rtol=0.0)


def test_no_general_minimiser_does_better() -> None:
    q = configurations((), 6, torch.float64, generator(4), bend=0.5)
    points = TRUE.points(q, PLANT, 30)
    fit = best_fit(MODEL, points, STRAIGHT, PI, iterations=150)
    torch.testing.assert_close(fit.error, shape_error(points, MODEL.points(fit.q, PI, 30)))

    def cost(x: list[float]) -> float:
        return float(shape_error(points, MODEL.points(torch.tensor(x, dtype=torch.float64), PI, 30)))

    found = minimize(cost, fit.q.tolist(), method="Powell", options={"xtol": 1e-6, "ftol": 1e-8, "maxiter": 6})
    assert float(fit.error) < 1.01 * found.fun
    assert float(fit.error) < 0.8 * float(shape_error(points, MODEL.points(STRAIGHT, PI, 30)))


def test_free_lengths_help_only_material_points() -> None:
    points = {s: TRUE.points(configurations((4,), 6, torch.float64, generator(7), 0.5), PLANT, 30, s) for s in SPACINGS}
    fixed = {s: best_fit(MODEL, points[s], STRAIGHT, PI, False, s, 150).error for s in SPACINGS}
    freed = {s: best_fit(MODEL, points[s], STRAIGHT, PI, True, s, 150).error for s in SPACINGS}
    torch.testing.assert_close(freed["arc"], fixed["arc"], rtol=0.05, atol=0.0)
    assert bool((freed["material"] < fixed["material"] * 1.001).all())
    assert float(freed["material"].mean()) < 0.9 * float(fixed["material"].mean())


SPACINGS = ("arc", "material")


@pytest.mark.parametrize("spacing", ["arc", "material"])
@given(seed=seeds)
def test_its_derivative_is_that_of_the_points(spacing: str, seed: int) -> None:
    q = configurations((), 3, torch.float64, generator(seed), bend=0.8)
    placed, columns = _curve(MODEL, q, PI, 9, spacing, True)
    torch.testing.assert_close(placed, MODEL.points(q, PI, 9, spacing))
    slopes = torch.autograd.functional.jacobian(lambda q, pi: MODEL.points(q, pi, 9, spacing), (q, PI))
    torch.testing.assert_close(columns, torch.cat(slopes, dim=-1), atol=1e-9, rtol=1e-7)


def test_a_bad_row_stays_alone() -> None:
    points = MODEL.points(configurations((3,), 3, torch.float64, generator(2), 0.5), PI, 20)
    bad = points.clone()
    bad[1, 4] = torch.nan
    good, poisoned = best_fit(MODEL, points, STRAIGHT, PI), best_fit(MODEL, bad, STRAIGHT, PI)
    for was, now in zip(good, poisoned, strict=True):
        assert torch.equal(bits(was[[0, 2]]), bits(now[[0, 2]]))


def test_bad_arguments() -> None:
    with pytest.raises(ShapeError, match="points must have at least 2"):
        best_fit(MODEL, torch.zeros(1, 3).double(), STRAIGHT, PI)
    with pytest.raises(ValueRangeError, match="iterations must be at least 1"):
        best_fit(MODEL, torch.zeros(5, 3).double(), STRAIGHT, PI, iterations=0)
    with pytest.raises(ValueRangeError, match="spacing must be"):
        best_fit(MODEL, torch.zeros(5, 3).double(), STRAIGHT, PI, spacing="even")
