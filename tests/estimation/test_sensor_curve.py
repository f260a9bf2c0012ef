"""The curve through the sensors against arcs, SciPy's cubic spline, and its own end conditions."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from scipy.interpolate import CubicSpline
from torch import Tensor

from apcc_torch.errors import ApccError, ConfigError, ShapeError, ValueRangeError
from apcc_torch.estimation.sensor_curve import SensorCurve
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, PI, configurations
from laws import FLOATS, check_bad_row, check_batching, generator, seeds

BACKBONE = PCCBackbone(3, HANGING_BASE)
ENDS = PI.cumsum(0)


def measured(q: Tensor, X: Tensor = ENDS) -> Tensor:
    return BACKBONE.pose(q, PI, *decouple(X, PI))


@given(seed=seeds)
def test_through_section_ends_it_is_the_arm(seed: int) -> None:
    # A cubic with the arc's own end tangents and length follows an arc of 0.8 rad to 1e-3 of its length; its points
    # are not quite evenly spaced, so they are compared across the arm.
    q = configurations((4,), 3, torch.float64, generator(seed), bend=0.55, elongation=0.02)
    curve = SensorCurve(HANGING_BASE, ENDS)
    there = BACKBONE.pose(q, PI, *decouple(curve.abscissae, PI))
    off = (there[..., :3, :3].mT @ (curve(measured(q)) - there[..., :3, 3]).unsqueeze(-1)).squeeze(-1)
    assert off[..., :2].norm(dim=-1).max() < 5e-4


@pytest.mark.parametrize("tangents", ["measured", "spline"])
@given(seed=seeds)
def test_it_passes_the_sensors_and_leaves_the_base_along_its_axis(tangents: str, seed: int) -> None:
    T = measured(configurations((), 3, torch.float64, generator(seed)), torch.tensor([0.1, 0.3, 0.55]).double())
    curve = SensorCurve(HANGING_BASE, torch.tensor([0.1, 0.3, 0.55], dtype=torch.float64), tangents, samples=5)
    points = curve(T)
    torch.testing.assert_close(points[4::5], T[:, :3, 3])
    fine = SensorCurve(HANGING_BASE, torch.tensor([0.1, 0.3, 0.55], dtype=torch.float64), tangents, samples=10_000)
    start = fine(T)[0]
    torch.testing.assert_close(start / start.norm(), HANGING_BASE[:, 2], atol=1e-3, rtol=0.0)
    torch.testing.assert_close(curve.abscissae[4::5], torch.tensor([0.1, 0.3, 0.55], dtype=torch.float64))


@given(seed=seeds)
def test_the_spline_has_the_tangents_of_scipys(seed: int) -> None:
    T = measured(configurations((), 3, torch.float64, generator(seed)))
    position = torch.cat((torch.zeros(1, 3, dtype=torch.float64), T[:, :3, 3]))
    chord = torch.cat((torch.zeros(1, dtype=torch.float64), position.diff(dim=0).norm(dim=-1).cumsum(0)))
    spline = CubicSpline(
        chord.numpy(), position.numpy(), bc_type=((1, HANGING_BASE[:, 2].numpy()), (2, torch.zeros(3).numpy()))
    )
    slope = torch.from_numpy(spline(chord.numpy(), 1))
    with_axes = T.clone()
    # Its own curve with these tangents given as the sensors' axes must be the same curve.
    with_axes[:, :3, 2] = (slope / slope.norm(dim=-1, keepdim=True))[1:]
    torch.testing.assert_close(
        SensorCurve(HANGING_BASE, ENDS, "spline")(T), SensorCurve(HANGING_BASE, ENDS, "measured")(with_axes)
    )


@pytest.mark.parametrize("tangents", ["measured", "spline"])
def test_a_straight_arm_is_a_straight_line(tangents: str) -> None:
    curve = SensorCurve(HANGING_BASE, ENDS, tangents)
    points = curve(measured(torch.zeros(9, dtype=torch.float64)))
    torch.testing.assert_close(points, -curve.abscissae.unsqueeze(-1) * torch.tensor([0.0, 0.0, 1.0]).double())


@pytest.mark.parametrize("tangents", ["measured", "spline"])
def test_batching(tangents: str) -> None:
    curves = {dtype: SensorCurve(HANGING_BASE.to(dtype), ENDS.to(dtype), tangents) for dtype in FLOATS}

    def make(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
        return (measured(configurations(shape, 3, torch.float64, rng)).to(dtype),)

    check_batching(lambda T: curves[T.dtype](T), make)
    check_bad_row(lambda T: curves[T.dtype](T), make((4,), torch.float64, generator()))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"abscissae": torch.tensor([0.0, 0.2])}, ValueRangeError, "abscissae must increase"),
        ({"abscissae": torch.tensor([0.2, 0.1])}, ValueRangeError, "abscissae must increase"),
        ({"tangents": "guessed"}, ConfigError, "tangents must be one of"),
        ({"samples": 0}, ValueRangeError, "samples must be in"),
    ],
)
def test_bad_arguments(arguments: dict[str, object], error: type[ApccError], message: str) -> None:
    with pytest.raises(error, match=message):
        SensorCurve(**{"base_rotation": HANGING_BASE, "abscissae": ENDS, **arguments})  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="T must have shape"):
        SensorCurve(HANGING_BASE, ENDS)(torch.eye(4).double())


@pytest.mark.parametrize("tangents", ["measured", "spline"])
def test_a_straight_arm_has_a_straight_curve_in_single_precision_too(tangents: str) -> None:
    curve = SensorCurve(HANGING_BASE.float(), ENDS.float(), tangents)
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, :3, :3], T[:, 2, 3] = HANGING_BASE.float(), -ENDS.float()
    want = torch.zeros(len(curve.abscissae), 3)
    want[:, 2] = -curve.abscissae
    torch.testing.assert_close(curve(T), want, rtol=0, atol=1e-6)
