"""Settings: ranges and names checked alike for all, and those that may differ by row as if each row were alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import Field, fields
from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.pid import TendonPID, ramp
from apcc_torch.control.pressure import PressureControl, PressureControlSettings
from apcc_torch.control.shape_law import ShapeLaw, ShapeLawSettings
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.control.trajectory import SineTrajectory
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.arc_fit import ArcFit
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.pose_filter import PoseFilter
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.shape_feedback import ShapeFeedback
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.chambers import Chambers
from apcc_torch.part import Configurable, part_of
from apcc_torch.settings import About, Settings, about_of, aligned, check_setting, default_of, is_on, names, resolved
from apcc_torch.simulation.curvature_sensors import CurvatureSensors
from apcc_torch.simulation.events import ArmEvents
from apcc_torch.simulation.inertial_units import InertialUnits
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.rod_plant import RodPlant
from apcc_torch.simulation.sensors import PoseSensors
from arms import HANGING_BASE, PI
from every_class import needed, settings_classes, subclasses

ROWS = 3


def rows(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("bad", [-1.0, float("inf"), float("nan")])
def test_a_number_and_a_row_are_refused_alike(bad: float) -> None:
    for value in (bad, rows(1.0, bad)):
        with pytest.raises(ValueRangeError, match="gain must be zero or positive and finite, got"):
            check_setting("gain", value, zero=True)
    with pytest.raises(ValueRangeError, match=r"gain must be positive and finite, got 0\.0"):
        check_setting("gain", rows(1.0, 0.0))
    good = rows(0.0, 2.0)
    assert check_setting("gain", good, zero=True) is good and check_setting("gain", 2.0) == 2.0


def test_aligned_puts_the_rows_before_what_they_scale() -> None:
    assert aligned(2.0, 2) == 2.0 and aligned(rows(1.0, 2.0), 2).shape == (2, 1, 1)
    # Rows share the branches of a step, so a tensor of zeros takes the same as one of others.
    assert is_on(rows(0.0, 1.0)) and is_on(rows(0.0, 0.0)) and is_on(0.5) and not is_on(0.0)


SETTINGS = settings_classes()


def numbers_of(kind: type[Settings]) -> Iterator[tuple[Field[Any], About]]:
    """The settings that are a number, or one a row."""
    return ((each, about_of(each)) for each in fields(kind) if about_of(each).rows == "number")


NUMBERS = [(kind, each.name) for kind in SETTINGS for each, _ in numbers_of(kind)]


@pytest.mark.parametrize(("kind", "name"), NUMBERS, ids=[f"{kind.__name__}.{name}" for kind, name in NUMBERS])
def test_a_range_holds_for_a_number_and_for_every_row(kind: type[Settings], name: str) -> None:
    each, about = next((each, about) for each, about in numbers_of(kind) if each.name == name)
    default, whole = default_of(each), str(each.type).startswith("int")
    good = [value for value in (default, 1, 3, 0.5) if value is not None]
    good = next(value for value in good if inside(about, value))
    tried = (-1, 0) if whole else (-1.0, 0.0, 1.0, 1e9, float("inf"), float("-inf"), float("nan"))
    bad = [value for value in tried if not inside(about, value)]
    assert bad
    others = needed(kind)
    for value in bad:
        for setting in (value, torch.tensor([good, value])):
            with pytest.raises(ValueRangeError, match=f"^{name} must be .*, got {value}"):
                kind(**{**others, name: setting})
    both = torch.tensor([good, good])
    assert getattr(kind(**{**others, name: both}), name) is both
    with pytest.raises(ConfigError, match=f"^{name} must be a(n?) (whole )?number, got 'much'"):
        kind(**{**others, name: "much"})


def inside(about: About, value: float) -> bool:
    try:
        about.check("value", value)
    except ValueRangeError:
        return False
    return True


@pytest.mark.parametrize("kind", SETTINGS, ids=lambda kind: kind.__name__)
def test_an_unknown_name_is_refused_with_what_may_be_meant(kind: type[Settings]) -> None:
    known = names(kind)
    longest = max(known, key=len)
    misspelt = f"{longest}x"
    with pytest.raises(ConfigError, match=rf"^\w* ?has no setting '{misspelt}'; did you mean {longest}\?$"):
        resolved(kind, (), {misspelt: 1})
    with pytest.raises(ConfigError, match=f"has no setting 'qqqq'; it has {', '.join(known)}$"):
        resolved(kind, (), {"qqqq": 1})


def test_too_many_values_and_values_given_twice_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"^TaskIntegral takes at most 2 settings, got 3$"):
        TaskIntegral(1.0, 2.0, 3.0)
    with pytest.raises(ConfigError, match=r"^TaskIntegral: gain is given twice$"):
        TaskIntegral(1.0, gain=2.0)
    with pytest.raises(ConfigError, match=r"^TaskIntegral takes TaskIntegralSettings, got TendonPIDSettings$"):
        TaskIntegral(TendonPID.settings_type())
    with pytest.raises(ConfigError, match=r"^Arm: lengths must be given$"):
        resolved(Arm, (), {})


def law(**settings: Any) -> Tensor:
    made = AdaptiveLaw(3, 2.0, **settings)
    e = 0.01 * randn(ROWS, 3)
    return made(PI.expand(ROWS, 3), randn(ROWS, 3, 3, seed=1), e, rows(0.1, 0.1, 0.1))


def solver(**settings: Any) -> Tensor:
    made = InverseKinematics(1.5, **{"null_gain": 0.05, **settings})
    return made(randn(ROWS, 3, 9), randn(ROWS, 3, seed=1), randn(ROWS, 3, seed=2), 0.1 * randn(ROWS, 9, seed=3))


def solver_over_a_period(**settings: Any) -> Tensor:
    shape = {"null_gain": 0.5, "null_step": 0.1, "null_bends": rows(0.5, 0.2, -0.1)}
    made = InverseKinematics(1.5, **{**shape, **settings})
    arguments = randn(ROWS, 3, 9), randn(ROWS, 3, seed=1), randn(ROWS, 3, seed=2), 0.1 * randn(ROWS, 9, seed=3)
    return made(*arguments, rows(0.01, 0.02, 0.03))


def pid(**settings: Any) -> Tensor:
    made = TendonPID(**settings)
    z, y, ydot, y_d, ydot_d = (0.01 * randn(ROWS, 4, seed=i) for i in range(5))
    return torch.cat((made(z, y, ydot, y_d, ydot_d), made.integrate(z, y, y_d, 0.1)), dim=-1)


def pressed(**settings: Any) -> Tensor:
    """Chambers that are asked for more than they can do."""
    arm = Arm(lengths=[0.145, 0.145], mass=0.3, chambers=Chambers(rest_pressure=2e4))
    made = PressureControl.on(arm, PressureControlSettings(**settings))
    assert made is not None
    y, y_d = 0.002 * randn(ROWS, 6, seed=1), 0.02 * randn(ROWS, 6, seed=2)
    state = made.initial_state(y)
    for k in range(4):
        state, p = made(state, y_d, y + 0.001 * k, rows(0.01, 0.01, 0.01))
    bounds = made.bounds(state, PCCBackbone(2).coordinates)
    return torch.cat((1e-5 * p, state.z, *(bound.clamp(-99.0, 99.0) for bound in bounds[:2])), dim=-1)


def inferred(**settings: Any) -> Tensor:
    backbone = PCCBackbone(3, HANGING_BASE)
    at = settings.pop("abscissae", rows(0.1, 0.35, 0.6))
    truth = 0.4 * randn(ROWS, 9) * rows(1.0, 1.0, 0.05).repeat(3)
    # Off the model, so that thresholds, weights and step bounds decide where the iteration ends.
    off = se3.exp(settings.pop("misfit", 0.0) * randn(ROWS, 3, 6, seed=1) * rows(1.0, 1.0, 1.0, 0.1, 0.1, 0.1))
    T = backbone.pose(truth, PI * 1.02, *decouple(rows(0.1, 0.35, 0.6), PI)) @ off
    found = StateFeedback(backbone, at, max_iterations=3, **settings)(torch.zeros_like(truth), PI.expand(ROWS, 3), T)
    return torch.cat((found.q_bar, found.angular_error, found.linear_error, found.status.unsqueeze(-1)), dim=-1)


def weighed(**settings: Any) -> Tensor:
    return inferred(misfit=0.1, **settings)


def hierarchical(**settings: Any) -> Tensor:
    return inferred(mode="hierarchical", **settings)


def filtered(**settings: Any) -> Tensor:
    made = SavitzkyGolay(order=2, **settings)
    state = made.initial_state(torch.zeros(ROWS, 2, dtype=torch.float64), torch.zeros(ROWS, dtype=torch.float64))
    for k in range(12):
        state, slope = made(state, randn(ROWS, 2, seed=k), torch.full((ROWS,), 0.01 * (k + 1), dtype=torch.float64))
    return slope


def carried(**settings: Any) -> Tensor:
    backbone, X = PCCBackbone(3, HANGING_BASE), rows(0.1, 0.35, 0.6)
    made, lengths = PoseFilter(**{"angular_time": 0.1, "linear_time": 0.1, **settings}), PI.expand(ROWS, 3)
    q = 0.3 * randn(ROWS, 9) * rows(1.0, 1.0, 0.05).repeat(3)
    seen, dt = torch.ones(ROWS, 3, dtype=torch.bool), rows(0.02, 0.02, 0.02)
    state = made.initial_state(q, 3)
    for k in range(3):
        moved = (1.0 + 0.1 * k) * q
        state, T = made(state, backbone.pose(moved, lengths, *decouple(X, lengths)), seen, seen, dt)
        points = backbone.material_points(lengths, *decouple(X.expand(ROWS, 3), lengths))
        state = made.moved(state, backbone, points, moved, 0.1 * q)
    return T.flatten(-3)


def integrated(**settings: Any) -> Tensor:
    return TaskIntegral(**settings)(1e-3 * randn(ROWS, 3), 1e-3 * randn(ROWS, 3, seed=1), rows(0.1, 0.1, 0.1))


SENSORS = rows(0.105, 0.36, 0.6)


def estimator(X: Tensor = SENSORS) -> StateFeedback:
    return StateFeedback(PCCBackbone(3, HANGING_BASE), X, angular_weight=0.1, max_iterations=5)


def sensed(**settings: Any) -> Tensor:
    made = PoseSensors(**settings)
    T = torch.eye(4, dtype=torch.float64).expand(ROWS, 2, 4, 4)
    draws = made.draw(T, torch.Generator().manual_seed(3), 2)
    seen = made.sense(made.initial_state(T), T, None, draws)[1]
    y = made.measured_tendons(torch.zeros(ROWS, 2).double(), torch.full((ROWS, 2), -5.0).double(), draws)
    return torch.cat((seen.T.flatten(-2), seen.mask.unsqueeze(-1), y.unsqueeze(-1)), dim=-1)


def sine(omega: Any) -> Tensor:
    target = SineTrajectory(randn(ROWS, 3), randn(ROWS, 3, seed=1), omega)(torch.tensor(0.7, dtype=torch.float64))
    return torch.cat((target.x_d.expand(ROWS, 3), target.xdot_d), dim=-1)


def controlled(**settings: Any) -> Tensor:
    made = APCCController(
        PCCBackbone(3, HANGING_BASE), estimator(), SavitzkyGolay(3, 1), InverseKinematics(2.0), (), **settings
    )
    q = 0.3 * randn(ROWS, 9) * rows(1.0, 1.0, 0.01).repeat(3)
    T = made.backbone.pose(q, PI, *decouple(SENSORS, PI))
    target = Target(rows(0.2, 0.1, -0.5).expand(ROWS, 3), torch.zeros(ROWS, 3, dtype=torch.float64))
    return made(made.initial_state(q, PI), Measurement(T, rows(0.1, 0.1, 0.1)), target)[1].q_d


def hung(**settings: Any) -> Tensor:
    made = LoadedShape.on(Arm(lengths=PI.tolist()), LoadedShapeSettings(**settings))
    return followed(ShapeFeedback(made, ArcFit(PCCBackbone(3, HANGING_BASE), PI)))


MIXED = Arm(lengths=PI.tolist(), sensed=("orientation", "pose", "tilt"), curvature_sensors=(0.1, 0.4))


def hung_mixed(**settings: Any) -> Tensor:
    made = LoadedShape.on(MIXED, LoadedShapeSettings(**settings))
    return followed(ShapeFeedback(made, ArcFit(PCCBackbone(3, HANGING_BASE), PI)))


def led_mixed(**settings: Any) -> Tensor:
    law = ShapeLaw(PI, estimator(), **settings)
    return followed(law.shape_feedback(MIXED, PCCBackbone(3, HANGING_BASE)))


def fitted(**settings: Any) -> Tensor:
    made = LoadedShape.on(Arm(lengths=PI.tolist()), LoadedShapeSettings())
    return followed(ShapeFeedback(made, ArcFit(PCCBackbone(3, HANGING_BASE), PI, **settings)))


def led(**settings: Any) -> Tensor:
    law = ShapeLaw(PI, estimator(), **settings)
    return followed(law.shape_feedback(Arm(lengths=PI.tolist()), PCCBackbone(3, HANGING_BASE)))


def followed(of: ShapeFeedback) -> Tensor:
    """q_bar and the load after two steps, of sensors and tendons that do not agree."""
    q, dt, y = 0.3 * randn(ROWS, 9) * rows(1.0, 1.0, 0.05).repeat(3), rows(0.02, 0.03, 0.04), 2e-3 * randn(ROWS, 9)
    T, counts = PCCBackbone(3, HANGING_BASE).pose(q, PI, *decouple(PI.cumsum(0), PI)), torch.ones(ROWS, 3).bool()
    curvature = 2.0 * randn(ROWS, 2, 2)
    state, q_bar = of.initial_state(0.8 * q, PI.expand(ROWS, 3)), 0.8 * q
    for _ in range(2):
        state, q_bar = of(state, q_bar, PI.expand(ROWS, 3), T, counts, counts, y, dt, curvature)
    return torch.cat((q_bar, state.shape.sections, state.shape.load.unsqueeze(-1)), dim=-1)


def taken_over(**settings: Any) -> Tensor:
    made = APCCController.for_arm(Arm(lengths=PI.tolist()), adaptation=ShapeLawSettings(**settings))
    q = 0.3 * randn(ROWS, 9) * rows(1.0, 1.0, 0.05).repeat(3)
    T = made.backbone.pose(q, PI, *decouple(PI.cumsum(0), PI))
    target = Target(rows(0.2, 0.1, -0.5).expand(ROWS, 3), torch.zeros(ROWS, 3, dtype=torch.float64))
    return made(made.initial_state(q, PI.expand(ROWS, 3)), Measurement(T, rows(0.1, 0.1, 0.1)), target)[0].pi_hat


def moved(kind: type[Plant] = Plant, **settings: Any) -> Tensor:
    made = kind.on(Arm(lengths=[0.2, 0.25]), rows(0.0, 0.1, 0.3), kind.settings_type(refine=1, **settings))
    now = made.straight((ROWS,))
    pull = ramp(now.z, 0.01 * randn(ROWS, now.z.shape[-1]), 1.0, 0.01)
    for k in range(3):
        now = made.advance(now, pull, 0.005, k)
    return now.arm.q


def sheared(**settings: Any) -> Tensor:
    return moved(RodPlant, **settings)


def happened(**settings: Any) -> Tensor:
    made = ArmEvents(2, **{"taken": 0.1, "taken_at": 2.0, "growth": 0.1, **settings})
    time = rows(1.0, 2.0, 6.0)
    return torch.cat((made.payload(rows(0.1, 0.2, 0.3), time).unsqueeze(-1), made.growth_at(time)), dim=-1)


def carried_along(**settings: Any) -> Tensor:
    made = InertialUnits(**{"tilt_noise": 1e-3, **settings})
    state = made.initial_state(torch.zeros(ROWS, 2).double(), torch.Generator().manual_seed(1))
    return made(state, torch.eye(3).double().expand(ROWS, 2, 3, 3), randn(ROWS, 2, 4))[1]


def read_off(**settings: Any) -> Tensor:
    made = CurvatureSensors(**settings)
    state = made.initial_state(torch.zeros(ROWS, 2, 2).double(), 0, torch.Generator().manual_seed(1))
    return made(state, torch.zeros(ROWS, 2, 2).double(), randn(ROWS, 2, 2))[1]


HUNG: dict[str, tuple[float, ...]] = {
    "position_noise": (1e-4, 1e-3, 1e-2),
    "angular_noise": (1e-3, 1e-2, 0.1),
    "tendon_noise": (1e-4, 1e-3, 1e-2),
    "bend": (0.1, 1.0, 9.0),
    "elongation": (0.01, 0.1, 1.0),
    "load": (0.01, 0.1, 1.0),
    "load_rate": (0.01, 0.1, 1.0),
    "sag_time": (0.1, 0.2, 9.0),
}
HUNG_MIXED: dict[str, tuple[float, ...]] = {
    "tilt_noise": (1e-3, 1e-2, 0.1),
    "heading_noise": (0.0, 1e-2, 0.3),
    "heading_drift": (0.0, 0.1, 9.0),
    "curvature_noise": (0.01, 0.1, 1.0),
}
FITTED: dict[str, tuple[float, ...]] = {"curve_noise": (1e-4, 1e-3, 1e-2), "length_prior": (0.01, 0.1, 1.0)}

USES: dict[tuple[type, Callable[..., Tensor]], dict[str, tuple[float, ...]]] = {
    (AdaptiveLaw, law): {
        "rate": (1e-4, 1e-3, 1.0),
        "normalisation": (0.0, 1.0, 10.0),
        "dead_zone": (0.0, 1e-3, 1.0),
        "gain_scale": (0.1, 1.0, 5.0),
    },
    (InverseKinematics, solver): {
        "damping": (0.0, 1e-2, 1.0),
        "null_gain": (0.0, 0.2, 1.0),
        "epsilon": (1e-3, 1e-2, 1.0),
        "bend_rate": (0.01, 0.1, 9.0),
        "length_rate": (0.01, 0.1, 9.0),
    },
    (InverseKinematics, solver_over_a_period): {
        "null_step": (0.01, 0.1, 0.5),
        "null_speed": (1e-3, 1.0, 9.0),
        "epsilon": (1e-3, 1e-2, 1.0),
    },
    (TendonPID, pid): {
        "K_P": (0.0, 10.0, 750.0),
        "K_I": (0.0, 1.0, 5.0),
        "K_D": (0.0, 1.0, 5.0),
        "force_limit": (0.1, 1.0, 100.0),
        "integral_limit": (1e-4, 1e-2, 1.0),
    },
    (PressureControl, pressed): {
        "K_P": (0.0, 0.1, 1.0),
        "K_I": (0.0, 0.5, 5.0),
        "K_D": (0.0, 0.1, 1.0),
        "rate_time": (0.01, 0.03, 0.3),
        "bend_rate": (0.1, 2.0, 9.0),
        "windup_time": (0.02, 0.1, 1.0),
    },
    (StateFeedback, weighed): {
        "angular_weight": (0.1, 0.3, 1.0),
    },
    (StateFeedback, inferred): {
        "linear_threshold": (1e-6, 1e-3, 1.0),
        "angular_threshold": (1e-6, 0.1, 3.0),
        "bend_step": (0.01, 0.2, 2.0),
        "length_step": (1e-4, 1e-3, 0.1),
        "damping": (1e-8, 1e-3, 1.0),
        "settled_step": (1e-9, 0.5, 9.0),
    },
    (StateFeedback, hierarchical): {
        "linear_threshold": (1e-6, 1e-3, 1.0),
    },
    (SavitzkyGolay, filtered): {
        "window": (3, 5, 9),
    },
    (PoseFilter, carried): {
        "angular_time": (0.0, 0.05, 0.5),
        "linear_time": (0.0, 0.05, 0.5),
        "follow": (0.0, 0.7, 1.0),
    },
    (TaskIntegral, integrated): {
        "gain": (0.0, 0.5, 2.0),
        "reach": (1e-4, 1e-3, 1e-2),
    },
    (PoseSensors, sensed): {
        "position_noise": (1e-3, 1e-2, 1.0),
        "angular_noise": (1e-3, 1e-2, 1.0),
        "dropout": (0.1, 0.5, 0.9),
        "tendon_noise": (1e-4, 1e-3, 1e-2),
        "tendon_stretch": (1e-5, 1e-4, 1e-3),
    },
    (SineTrajectory, sine): {
        "omega": (0.1, 1.0, 3.0),
    },
    (APCCController, controlled): {
        "bend_bound": (0.05, 0.1, 1.0),
        "elongation_bound": (1e-5, 1e-4, 1e-3),
    },
    (LoadedShape, hung): HUNG,
    (LoadedShape, hung_mixed): HUNG_MIXED,
    (ShapeLaw, led_mixed): HUNG_MIXED,
    (InertialUnits, carried_along): {
        "tilt_noise": (1e-3, 1e-2, 0.1),
        "mounting": (1e-3, 1e-2, 0.1),
        "heading": (1e-3, 1e-2, 0.1),
        "heading_drift": (1e-2, 0.1, 1.0),
    },
    (CurvatureSensors, read_off): {
        "noise": (1e-3, 1e-2, 0.1),
        "offset": (1e-3, 1e-2, 0.1),
    },
    (ArcFit, fitted): FITTED,
    (ShapeLaw, led): {**HUNG, **FITTED},
    (ShapeLaw, taken_over): {
        "time_constant": (0.15, 0.3, 3.0),
    },
    (Plant, moved): {
        "tendon_damping": (0.0, 50.0, 500.0),
        "backlash": (0.0, 1e-3, 9e-3),
    },
    (RodPlant, sheared): {
        "radius": (0.01, 0.02, 0.04),
        "poisson": (0.0, 0.3, 0.5),
        "spacing": (0.01, 0.02, 0.04),
    },
    (ArmEvents, happened): {
        "taken": (-0.15, 0.0, 0.5),
        "taken_at": (0.5, 2.5, 4.0),
        "growth_from": (0.0, 1.0, 5.5),
        "growth_over": (0.5, 10.0, 100.0),
    },
}
"""Parts in use, and three values for each of their numbers: one a row."""


@pytest.mark.parametrize(
    ("make", "name", "values"),
    [(make, name, values) for (_, make), tried in USES.items() for name, values in tried.items()],
)
def test_each_row_is_as_if_its_number_were_every_row_s(
    make: Callable[..., Tensor], name: str, values: tuple[float, ...]
) -> None:
    together = make(**{name: torch.tensor(values) if name == "window" else rows(*values)})
    alone = [make(**{name: value}) for value in values]
    torch.testing.assert_close(together, torch.stack([alone[i][i] for i in range(ROWS)]), rtol=1e-9, atol=1e-12)
    # The setting matters, or the comparison would show nothing.
    assert not torch.allclose(alone[0], alone[2], rtol=1e-6, atol=1e-9)


def test_every_number_of_every_part_is_tried() -> None:
    tried = {(part, name) for (part, _), values in USES.items() for name in values}
    for part in subclasses(Configurable):
        if part.__module__.startswith("apcc_torch."):
            for each, _ in numbers_of(part.settings_type):
                assert any((base, each.name) in tried for base in part.__mro__), f"{part.__name__}.{each.name}"


def test_every_settings_class_knows_its_part() -> None:
    for part in subclasses(Configurable):
        assert part_of(part.settings_type.__new__(part.settings_type)) is part


def test_abscissae_may_differ_from_row_to_row() -> None:
    sets = [rows(0.1, 0.35, 0.6), rows(0.12, 0.3, 0.58), rows(0.05, 0.2, 0.4)]
    together = inferred(abscissae=torch.stack(sets))
    alone = torch.stack([inferred(abscissae=at)[i] for i, at in enumerate(sets)])
    torch.testing.assert_close(together, alone, rtol=1e-9, atol=1e-12)


def test_the_shape_of_arms_that_differ_from_row_to_row() -> None:
    lengths = PI * rows(0.9, 1.0, 1.1).unsqueeze(-1)
    sensors = lengths.cumsum(-1) * rows(0.8, 0.9, 1.0).unsqueeze(-1)
    each = {
        "mass": rows(0.3, 0.5, 0.2),
        "bending_stiffness": rows(0.5, 0.8, 1.0),
        "tendon_offset": rows(0.02, 0.025, 0.03),
    }
    q = 0.3 * randn(ROWS, 9) * rows(1.0, 1.0, 0.05).repeat(3)
    T = PCCBackbone(3, HANGING_BASE).pose(q, PI, *decouple(SENSORS, PI))

    def step(at: int | slice) -> list[Tensor]:
        made = APCCController.for_arm(
            Arm(lengths=lengths[at], sensors=sensors[at], **{name: value[at] for name, value in each.items()})
        )
        state, target = (
            made.initial_state(0.9 * q[at], lengths[at]),
            Target(q[at][..., :3], torch.zeros_like(q[at][..., :3])),
        )
        for time in (0.1, 0.2):
            stamp = torch.full_like(q[at][..., 0], time)
            state, command = made(state, Measurement(T[at], stamp), target)
        return [command.y, state.q_bar, state.pi_hat, state.shape.shape.load]

    alone = [torch.stack(values) for values in zip(*(step(i) for i in range(ROWS)), strict=True)]
    torch.testing.assert_close(step(slice(None)), alone, rtol=1e-9, atol=1e-12)


def test_what_the_null_space_prefers_may_differ_from_row_to_row() -> None:
    for name in ("null_weights", "null_bends"):
        sets = [rows(1.0, 0.5, 2.0), rows(0.1, 3.0, 0.0), rows(0.0, 0.2, 0.4)]
        together = solver(null_gain=1.0, **{name: torch.stack(sets)})
        alone = [solver(null_gain=1.0, **{name: each}) for each in sets]
        torch.testing.assert_close(together, torch.stack([alone[i][i] for i in range(ROWS)]), rtol=1e-9, atol=1e-12)
        assert not torch.allclose(alone[0], alone[1], rtol=1e-6, atol=1e-9)


def test_draws_are_shared_where_runs_stand_side_by_side() -> None:
    T = torch.eye(4, dtype=torch.float64).expand(2, ROWS, 2, 4, 4)
    made = PoseSensors(rows(1e-3, 1e-2).unsqueeze(-1), 0.0, 0, 0.3, shared=1)
    _, seen, mask = made(made.initial_state(T), T, torch.Generator().manual_seed(5))
    single = PoseSensors(1e-3, 0.0, 0, 0.3)
    _, one, one_mask = single(single.initial_state(T[0]), T[0], torch.Generator().manual_seed(5))
    torch.testing.assert_close(seen[0], one)
    torch.testing.assert_close(seen[1] - T[1], 10.0 * (seen[0] - T[0]))
    assert torch.equal(mask[0], one_mask) and torch.equal(mask[1], one_mask)


def test_a_window_a_row_is_refused_with_a_period() -> None:
    with pytest.raises(ValueRangeError, match="period must be None"):
        SavitzkyGolay(torch.tensor([3, 5]), 2, period=0.01)
    with pytest.raises(ValueRangeError, match="window must be at least"):
        SavitzkyGolay(torch.tensor([2, 5]), 2)
