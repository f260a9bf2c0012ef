"""Mixed sensor sets: what each kind tells of the shape, its derivative, its weight, and what a set is worth."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from mixed_sensors import ARM, SETS, Found, Resting, estimated, resting, rods
from torch import Tensor

from apcc_torch import APCCController, Arm, Measurement, StateFeedback, Target, decouple
from apcc_torch.errors import ConfigError, ShapeError
from apcc_torch.estimation.counted import counted
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.shape_state import ShapeMeasurement, ShapeState
from apcc_torch.lie import so3
from apcc_torch.model.curvature import middle_curvature
from laws import generator, normal

D = torch.float64
ALL = Arm(
    lengths=[0.105, 0.255, 0.24],
    sensors=[0.1, 0.2, 0.4, 0.6],
    sensed=("orientation", "tilt", "position", "pose"),
    curvature_sensors=[0.05, 0.2, 0.5],
)
READINGS = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def bent(shape: LoadedShape, *rows: int) -> ShapeState:
    """Random shapes that bear something."""
    draw = generator(5)
    rest = ALL.rest_lengths()
    straight = torch.stack((0.0 * rest, 0.0 * rest, rest), dim=-1).flatten()
    scale = torch.tensor([0.4, 0.4, 0.01], dtype=D).repeat(3)
    state = shape.initial_state(straight + scale * normal((*rows, 9), D, draw))
    sag = 0.02 * normal((*rows, 2, 18), D, draw)
    return state._replace(sag=sag, load=0.2 + 0.0 * state.load, age=3.0 + 0.0 * state.load)


def read_off(shape: LoadedShape, state: ShapeState) -> READINGS:
    """What sensors without an error make of a shape, in the order of `LoadedShape.forward`."""
    q, lengths = shape.configuration(state), shape.dynamics.lengths
    T = shape.backbone.pose(q, lengths, *decouple(ALL.sensor_places(), lengths))
    kinds = ALL.sensor_kinds()
    assert kinds is not None and shape.curvature_weights is not None
    T = kinds.blanked(T)
    usable, oriented = counted(T, kinds)
    curvature = shape.curvature_weights @ middle_curvature(shape.backbone, q, lengths)
    y = (shape.B.mT @ q.unsqueeze(-1)).squeeze(-1)
    return T, usable, oriented, y, 0.02 + 0.0 * state.load, curvature


def residual(shape: LoadedShape, state: ShapeState, change: Tensor, told: READINGS) -> tuple[Tensor, Tensor]:
    moved = state._replace(sections=state.sections + change[..., :-1], load=state.load + change[..., -1])
    T, usable, oriented, y, _, curvature = told
    return shape.residual(moved, ShapeMeasurement(T, usable, oriented, y, curvature))


def test_without_an_error_nothing_is_left_and_the_derivative_is_autograds() -> None:
    shape = LoadedShape.on(ALL, LoadedShapeSettings())
    state, zero = bent(shape), torch.zeros(10, dtype=D)
    told = read_off(shape, state)
    r, J = residual(shape, state, zero, told)
    assert r.shape == (6 * 4 + 3 * 2 + 9 + 6,) and float(r.abs().max()) < 1e-9
    want = -torch.func.jacfwd(lambda change: residual(shape, state, change, told)[0])(zero)
    torch.testing.assert_close(J, want, rtol=1e-9, atol=1e-7)
    # What is not measured has no say.
    assert bool((J[6:9] == 0).all()) and bool((J[3:6] == 0).all()) and bool((J[12:15] == 0).all())


def test_curvature_that_is_off_has_the_exact_derivative_too() -> None:
    shape = LoadedShape.on(ALL, LoadedShapeSettings())
    state, zero = bent(shape), torch.zeros(10, dtype=D)
    told = read_off(shape, state)
    told = (*told[:-1], told[-1] + torch.tensor([1.0, -2.0], dtype=D))
    J = residual(shape, state, zero, told)[1]
    want = -torch.func.jacfwd(lambda change: residual(shape, state, change, told)[0])(zero)
    torch.testing.assert_close(J[-6:], want[-6:], rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("psi", [0.5, -2.0])
def test_a_heading_that_is_off_leaves_the_tilt_alone_and_the_gradient_exact(psi: float) -> None:
    shape = LoadedShape.on(ALL, LoadedShapeSettings())
    state, zero = bent(shape), torch.zeros(10, dtype=D)
    T, *others = read_off(shape, state)
    turn = so3.exp(torch.tensor([0.0, 0.0, psi], dtype=D))
    off = T.clone()
    off[:2, :3, :3] = turn @ T[:2, :3, :3]
    told: READINGS = (off, *others)  # type: ignore[assignment]
    r, J = residual(shape, state, zero, told)
    s = shape
    noise = (float(s.heading_noise) ** 2 + 3.0 * float(s.heading_drift) ** 2 + float(s.tilt_noise) ** 2) ** 0.5
    units = r[24:30].view(2, 3)
    assert float(units[0].norm()) == pytest.approx(abs(psi) / noise, rel=1e-9)
    assert float(units[1].norm()) < 1e-9  # a tilt has no heading
    half_square = torch.func.grad(lambda change: 0.5 * residual(shape, state, change, told)[0].square().sum())
    torch.testing.assert_close(J.mT @ r, -half_square(zero), rtol=1e-7, atol=1e-6)


def test_marginalised_headings_are_those_of_a_least_squares_with_them() -> None:
    """H of unit and heading together, with the heading eliminated, is what the rows have."""
    shape = LoadedShape.on(ALL.changed(curvature_sensors=None), LoadedShapeSettings())
    state = bent(shape)
    T, usable, oriented, *_ = read_off(LoadedShape.on(ALL, LoadedShapeSettings()), state)
    only = torch.tensor([True, False, False, False])
    _, J = shape.residual(state, ShapeMeasurement(T, usable & False, oriented & only, None))
    place = shape.chain_at(shape.configuration(state), shape.abscissae)
    omega = shape._moved(place.body_jacobian(), state)[0, :3]
    up, sigma = place.rotation[0, 2], float(shape.tilt_noise)
    prior = 1.0 / (float(shape.heading_noise) ** 2 + float(shape.heading_drift) ** 2 * 3.0)
    full = torch.cat((omega, up.unsqueeze(-1)), dim=-1) / sigma  # a heading turns the reading about the vertical
    H = full.mT @ full
    want = H[:-1, :-1] - H[:-1, -1:] @ H[-1:, :-1] / (H[-1, -1] + prior)
    torch.testing.assert_close(J.mT @ J, want, rtol=1e-9, atol=1e-6)


def test_rows_alone_and_in_a_batch_agree_and_gaps_stay_gaps() -> None:
    shape = LoadedShape.on(ALL, LoadedShapeSettings())
    start = bent(shape, 5)
    T, usable, oriented, y, dt, curvature = read_off(shape, bent(shape, 5))
    curvature = curvature.clone()
    curvature[1], curvature[2, 0, 1], y[3, 4] = torch.nan, torch.inf, torch.nan
    usable, oriented = usable.clone(), oriented.clone()
    oriented[0, 0], usable[4], oriented[4] = False, False, False
    told = (T, usable, oriented, y, dt, curvature)
    together = shape(start, *told)
    assert all(bool(torch.isfinite(part).all()) for part in together)
    for i in range(5):
        alone = shape(ShapeState(*(part[i] for part in start)), *(part[i] for part in told))
        for have, want in zip(alone, together, strict=True):
            torch.testing.assert_close(have, want[i], rtol=1e-9, atol=1e-9)


def test_poses_by_name_are_poses() -> None:
    named, arm = ARM.changed(sensors=(0.3, 0.6), sensed=("pose", "pose")), ARM.changed(sensors=(0.3, 0.6))
    true = resting(arm, arm.dynamics(2), LoadedShapeSettings(), 4)
    have, want = (estimated(each, true, LoadedShapeSettings(), steps=5) for each in (named, arm))
    assert torch.equal(have.shape, want.shape) and have.nees == want.nees


@cache
def on_rods(name: str) -> Found:
    """What a set makes of Cosserat rods, which another solver has at rest."""
    return estimated(SETS[name], hung(), LoadedShapeSettings(), steps=25)


@cache
def hung() -> Resting:
    return rods(ARM, LoadedShapeSettings(), rows=20)


@pytest.mark.parametrize(
    ("mixed", "alone", "share"),
    [
        ("pose at the tip, two inertial units", "pose at the tip", 0.75),
        ("pose at the tip, curvature at six places", "pose at the tip", 0.75),
        ("pose in the middle, two inertial units", "pose in the middle", 0.95),
    ],
)
def test_a_mixed_set_knows_the_shape_of_a_rod_better_than_its_pose_alone(mixed: str, alone: str, share: float) -> None:
    more, less = on_rods(mixed), on_rods(alone)
    assert len(more.shape) > 16
    assert float(more.shape.mean()) < share * float(less.shape.mean())
    assert float(more.tip.mean()) < 1.1 * float(less.tip.mean())


@pytest.mark.parametrize(
    "name", ["pose at the tip, two inertial units", "three inertial units, curvature at six places"]
)
def test_estimates_scatter_by_their_covariance(name: str) -> None:
    arm = SETS[name]
    true = resting(arm, arm.dynamics(2), LoadedShapeSettings(), 150)
    found = estimated(arm, true, LoadedShapeSettings(), steps=35)
    # Beside chance, which is the band, the arm is no linear function of what is measured.
    assert abs(found.nees - 1.0) < found.band + 0.05


def test_algorithm_2_takes_positions_and_poses_and_refuses_to_have_none() -> None:
    kinds, X = ALL.sensor_kinds(), ALL.sensor_places()
    q, pi = 0.2 * normal((9,), D, generator(3)), ALL.rest_lengths()
    backbone = ALL.backbone()
    T = backbone.pose(q, pi, *decouple(X, pi))
    assert kinds is not None
    mixed = StateFeedback(backbone, X, kinds=kinds)(0.9 * q, pi, kinds.blanked(T))
    poses = StateFeedback(backbone, X)(
        0.9 * q, pi, T, torch.tensor([False, False, True, True]), torch.tensor([False, False, False, True])
    )
    torch.testing.assert_close(mixed.q_bar, poses.q_bar, rtol=0, atol=1e-12)
    assert int(mixed.status) == int(poses.status)
    inertial = ALL.changed(sensed=("tilt",) * 4)
    with pytest.raises(ConfigError, match="algorithm 2 takes positions and poses"):
        APCCController.for_arm(inertial, adaptive=False)


def test_a_controller_runs_on_inertial_units_and_gratings_alone() -> None:
    arm = ALL.changed(sensed=("orientation", "orientation", "orientation", "tilt"))
    controller, shape = APCCController.for_arm(arm), LoadedShape.on(arm, LoadedShapeSettings())
    kinds = arm.sensor_kinds()
    assert kinds is not None and shape.curvature_weights is not None
    state = bent(shape)
    q, lengths = shape.configuration(state), shape.dynamics.lengths
    T = kinds.blanked(shape.backbone.pose(q, lengths, *decouple(arm.sensor_places(), lengths)))
    curvature = shape.curvature_weights @ middle_curvature(shape.backbone, q, lengths)
    zero = torch.zeros((), dtype=D)
    target = Target(torch.tensor([0.05, 0.0, -0.55], dtype=D), torch.zeros(3, dtype=D))
    now = controller.initial_state(torch.zeros(9, dtype=D), arm.rest_lengths(), zero)
    seen = Measurement(T, zero + 0.01, curvature=curvature)
    later, command = controller(now, seen, target)
    assert int(command.feedback.status) != int(FeedbackStatus.INVALID) and bool(torch.isfinite(command.qdot).all())
    # Nobody measures the tip: its error is that of the estimate.
    torch.testing.assert_close(
        command.e, target.x_d - controller.backbone.tip(command.feedback.q_bar, now.pi_hat), rtol=0, atol=1e-12
    )
    blind = Measurement(torch.full_like(T, torch.nan), zero + 0.02, curvature=torch.full_like(curvature, torch.nan))
    _, held = controller(later, blind, target)
    assert int(held.feedback.status) == int(FeedbackStatus.INVALID) and bool((held.qdot == 0).all())


def test_a_reading_of_curvature_of_another_form_is_refused() -> None:
    controller = APCCController.for_arm(ALL)
    now = controller.initial_state(torch.zeros(9, dtype=D), ALL.rest_lengths())
    target = Target(torch.zeros(3, dtype=D), torch.zeros(3, dtype=D))
    seen = Measurement(torch.eye(4, dtype=D).repeat(4, 1, 1), torch.tensor(0.01).double())
    with pytest.raises(ShapeError, match=r"measurement\.curvature must have shape"):
        controller(now, seen._replace(curvature=torch.zeros(3, dtype=D)), target)
    with pytest.raises(ShapeError, match=r"measurement\.curvature must have shape \(\.\.\., 3, 2\)"):
        controller(now, seen._replace(curvature=torch.zeros(2, 2, dtype=D)), target)
