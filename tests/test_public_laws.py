"""One law for every public operation: leading dimensions are a batch, dtype and device follow, rows do not mix.

A new operation joins by one line in `LAWS`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from apcc_torch import (
    AdaptiveLaw,
    APCCController,
    Arm,
    InverseKinematics,
    Measurement,
    PCCBackbone,
    SavitzkyGolay,
    SoftArmDynamics,
    StateFeedback,
    Target,
    TendonRouting,
    decouple,
    shape_error,
)
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.estimation.arc_fit import ArcFit
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.pose_filter import PoseFilter, PoseFilterState
from apcc_torch.estimation.shape_feedback import ShapeFeedback
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import section_fractions
from apcc_torch.simulation.metrics import mapping_error
from arms import HANGING_BASE, PI, configurations
from laws import FLOATS, MakeInputs, Op, check_bad_row, check_batching, generator, normal, uniform

BACKBONE = PCCBackbone(3, HANGING_BASE)
SENSORS = torch.tensor([0.09, 0.33, 0.58], dtype=torch.float64)
FILTER = SavitzkyGolay(window=4, order=2)
Shape = tuple[int, ...]


def feedback(mode: str) -> StateFeedback:
    # Neither the thresholds nor a settled step end a row early: rounding must not change how many steps are taken.
    return StateFeedback(
        BACKBONE, SENSORS, mode, angular_weight=0.3, max_iterations=4, min_iterations=4, settled_step=0.0
    )


def per_dtype(make: Callable[[torch.dtype], Any], call: Callable[..., Any]) -> Op:
    """An operation of a module that has the dtype of its parameters."""
    modules = {dtype: make(dtype) for dtype in FLOATS}
    return lambda x, *more: call(modules[x.dtype], x, *more)


def routing(dtype: torch.dtype) -> TendonRouting:
    angles = torch.arange(6, dtype=dtype)
    return TendonRouting(angles, torch.full_like(angles, 0.03), torch.linspace(0.1, 0.6, 6, dtype=dtype))


def arm_dynamics(dtype: torch.dtype) -> SoftArmDynamics:
    def row(*values: float) -> Tensor:
        return torch.tensor(values, dtype=dtype)

    return SoftArmDynamics(
        row(0.1, 0.2, 0.25), row(0.1, 0.15, 0.2), row(300.0, 250.0, 200.0), row(1.0, 0.8, 0.6), damping_ratio=0.1
    )


def make(*kinds: str) -> MakeInputs:
    """Inputs by name, each drawn anew."""

    def inputs(shape: Shape, dtype: torch.dtype, rng: torch.Generator) -> tuple[Any, ...]:
        lengths = PI + uniform((*shape, 3), 0.0, 0.03, torch.float64, rng)
        q = configurations(shape, 3, torch.float64, rng, bend=0.9)
        draws: dict[str, Callable[[], Any]] = {
            "q": lambda: q.to(dtype),
            "q_seed": lambda: (q + uniform(q.shape, -0.02, 0.02, torch.float64, rng)).to(dtype),
            "qdot": lambda: normal((*shape, 9), dtype, rng),
            "tau": lambda: 0.1 * normal((*shape, 9), dtype, rng),
            "L0": lambda: lengths.to(dtype),
            "X": lambda: uniform((*shape, 4), 0.0, 0.7, dtype, rng),
            "T": lambda: BACKBONE.pose(q, lengths, *decouple(SENSORS, lengths)).to(dtype),
            "J": lambda: normal((*shape, 3, 9), dtype, rng),
            "Y": lambda: normal((*shape, 3, 3), dtype, rng),
            "x": lambda: 0.1 * normal((*shape, 3), dtype, rng),
            "points": lambda: normal((*shape, 11, 3), dtype, rng),
            "time": lambda: uniform(shape, 0.05, 0.1, dtype, rng),
            "payload": lambda: uniform(shape, 0.0, 0.5, dtype, rng),
            "y": lambda: 1e-3 * normal((*shape, 9), dtype, rng),
            "curve": lambda: BACKBONE.points(q, lengths, 7)[..., 1:, :].to(dtype),
            "share": lambda: torch.linspace(1 / 6, 1.0, 6, dtype=dtype).expand(*shape, 6).clone(),
            "filter": lambda: filter_state(shape, dtype, rng),
            "state": lambda: controller_state(q, lengths, dtype, rng),
            "smooth_state": lambda: smooth_state(q, lengths, dtype, rng),
        }
        return tuple(draws[kind]() for kind in kinds)

    return inputs


def filter_state(shape: Shape, dtype: torch.dtype, rng: torch.Generator) -> Any:
    state = FILTER.initial_state(normal((*shape, 9), dtype, rng), torch.zeros(shape, dtype=dtype))
    for k in range(1, 4):
        state = FILTER.push(state, normal((*shape, 9), dtype, rng), torch.full(shape, 0.01 * k, dtype=dtype))
    return state


def controller_state(q: Tensor, lengths: Tensor, dtype: torch.dtype, rng: torch.Generator) -> Any:
    state = CONTROLLER.initial_state(q.to(dtype), lengths.to(dtype))
    return state._replace(velocity_filter=filter_state(q.shape[:-1], dtype, rng))


def smooth_state(q: Tensor, lengths: Tensor, dtype: torch.dtype, rng: torch.Generator) -> Any:
    state = SMOOTH_CONTROLLER.initial_state(q.to(dtype), lengths.to(dtype))
    expected = BACKBONE.pose(1.1 * q, lengths, *decouple(SENSORS, lengths)).to(dtype)
    age = uniform((*q.shape[:-1], 3, 2), 0.0, 0.1, dtype, rng)
    return state._replace(
        velocity_filter=filter_state(q.shape[:-1], dtype, rng),
        expected=PoseFilterState(expected, age, se3.exp(0.01 * normal((*q.shape[:-1], 2, 3, 6), dtype, rng))),
        integral=1e-3 * normal((*q.shape[:-1], 3), dtype, rng),
    )


def controller(**parts: Any) -> APCCController:
    law = AdaptiveLaw(3, 0.5, rate=0.5)
    end = torch.tensor([0.5], dtype=torch.float64)
    bounds = LengthBounds(PI, end, lower=(PI - 0.05) / PI, upper=(PI + 0.1) / PI, reach="last")
    null = {"null_weights": 2.0 * PI, "null_bends": 0.1 * PI}
    ik = InverseKinematics(null_gain=0.05, bend_rate=2.0, length_rate=0.5, **null)
    parts = {"bounds": bounds, "bend_bound": 1.0, "elongation_bound": 0.1, **parts}
    return APCCController(BACKBONE, feedback("pose"), FILTER, ik, law, **parts)


CONTROLLER = controller()
SMOOTH_CONTROLLER = controller(pose_filter=PoseFilter(0.1, 0.05, delay=2), integral=TaskIntegral(1.0, 0.1))


def adapted(pi_hat: Tensor, Y: Tensor, e: Tensor, dt: Tensor) -> Tensor:
    (law,) = CONTROLLER.laws
    assert isinstance(law, AdaptiveLaw) and CONTROLLER.bounds is not None
    return CONTROLLER.bounds(law(pi_hat, Y, e, dt), law.metric)


def control_step(of: APCCController) -> Op:
    return lambda state, T, time, tip, x_d, xdot_d: of(state, Measurement(T, time, tip=tip), Target(x_d, xdot_d))


ARM = Arm(lengths=PI.tolist(), mass=0.3, sensors=SENSORS)


def shape_feedback(dtype: torch.dtype) -> ShapeFeedback:
    return ShapeFeedback(LoadedShape.on(ARM, LoadedShapeSettings()), ArcFit(BACKBONE, PI)).to(dtype)


def led(dtype: torch.dtype) -> APCCController:
    return APCCController.for_arm(ARM).to(dtype)


def estimated(of: LoadedShape, strain: Tensor, T: Tensor, y: Tensor, dt: Tensor) -> Any:
    rest = of.dynamics.lengths.to(strain).unflatten(-1, (-1, of.refine)).sum(-1)
    state = of.initial_state(strain + torch.stack((0.0 * rest, 0.0 * rest, rest), dim=-1).flatten(-2))
    for _ in range(2):
        state = of(state, T, *(torch.isfinite(T).all(-1).all(-1),) * 2, y, dt)
    return state


def mixed(dtype: torch.dtype) -> LoadedShape:
    arm = ARM.changed(sensed=("orientation", "pose", "tilt"), curvature_sensors=(0.05, 0.3))
    return LoadedShape.on(arm, LoadedShapeSettings()).to(dtype)


def estimated_from_all(
    of: LoadedShape, strain: Tensor, T: Tensor, y: Tensor, dt: Tensor, X: Tensor, kappa: Tensor
) -> Any:
    state = estimated(of, strain, T, y, dt)
    counts = torch.isfinite(T).all(-1).all(-1)
    return of(state, T, counts, counts, y, dt, torch.stack((kappa[..., :2], X[..., :2]), dim=-1))


def followed(of: ShapeFeedback, q: Tensor, L0: Tensor, T: Tensor, y: Tensor, dt: Tensor) -> Any:
    return of(of.initial_state(q, L0), q, L0, T, *(torch.isfinite(T).all(-1).all(-1),) * 2, y, dt)


def step_along_the_shape(of: APCCController, q: Tensor, L0: Tensor, T: Tensor, time: Tensor, x: Tensor) -> Any:
    return of(of.initial_state(q, L0), Measurement(T, time), Target(x, torch.zeros_like(x)))


class Law(NamedTuple):
    """An operation, its inputs, which of them may be shared by the batch, and a factor on the tolerances."""

    op: Op
    inputs: MakeInputs
    shared: tuple[int, ...] = ()
    scale: float = 1.0


def at_points(method: Callable[..., Any]) -> Op:
    return lambda q, L0, X: method(q, L0, *decouple(X, L0))


def parameter_jacobian(q: Tensor, L0: Tensor, X: Tensor) -> Tensor:
    return BACKBONE.body_parameter_jacobian(q, L0, X, BACKBONE.body_jacobian(q, L0, *decouple(X, L0)))


LAWS: dict[str, Law] = {
    "tip": Law(BACKBONE.tip, make("q", "L0"), (0, 1)),
    "tip_jacobian": Law(BACKBONE.tip_jacobian, make("q", "L0"), (0, 1)),
    "tip_and_jacobian": Law(BACKBONE.tip_and_jacobian, make("q", "L0"), (0, 1)),
    "tip_jacobian_rate": Law(BACKBONE.tip_jacobian_rate, make("q", "qdot", "L0"), (0, 1, 2), 10.0),
    "pose": Law(at_points(BACKBONE.pose), make("q", "L0", "X"), (0, 1, 2), 10.0),
    "body_jacobian": Law(at_points(BACKBONE.body_jacobian), make("q", "L0", "X"), (0, 1, 2), 10.0),
    "body_parameter_jacobian": Law(parameter_jacobian, make("q", "L0", "X"), (0, 1, 2), 10.0),
    "points": Law(lambda q, L0: BACKBONE.points(q, L0, 13), make("q", "L0"), (0, 1), 10.0),
    "material_points": Law(lambda q, L0: BACKBONE.points(q, L0, 13, "material"), make("q", "L0"), (0, 1), 10.0),
    "regressor": Law(BACKBONE.regressor, make("q", "qdot"), (0, 1)),
    "decouple": Law(decouple, make("X", "L0"), (0, 1)),
    "section_fractions": Law(lambda X, L0: section_fractions(*decouple(X, L0), 3), make("X", "L0"), (0, 1)),
    "shape_error": Law(shape_error, make("points", "points"), (0, 1)),
    "mapping_error": Law(lambda q, L0, x: mapping_error(BACKBONE, q, L0, x), make("q", "L0", "x"), (0, 1, 2)),
    "velocity_filter": Law(FILTER, make("filter", "q", "time"), (1, 2), 10.0),
    "inverse_kinematics": Law(CONTROLLER.inverse_kinematics, make("J", "x", "x", "q"), (0, 1, 2, 3), 10.0),
    "adaptive_law": Law(adapted, make("L0", "Y", "x", "time"), (0, 1, 2, 3)),
    "total_regressor": Law(CONTROLLER.regressor, make("q", "qdot", "L0"), (0, 1, 2), 10.0),
    "controller": Law(control_step(CONTROLLER), make("state", "T", "time", "x", "x", "x"), (1, 2, 3, 4, 5), 10.0),
    "smooth_controller": Law(
        control_step(SMOOTH_CONTROLLER), make("smooth_state", "T", "time", "x", "x", "x"), (1, 2, 3, 4, 5), 10.0
    ),
    "loaded_shape": Law(
        per_dtype(lambda d: shape_feedback(d).shape, estimated), make("q_seed", "T", "y", "time"), (), 10.0
    ),
    "loaded_shape_of_mixed_sensors": Law(
        per_dtype(mixed, estimated_from_all), make("q_seed", "T", "y", "time", "X", "x"), (), 10.0
    ),
    "arc_fit": Law(
        per_dtype(lambda d: shape_feedback(d).fit, ArcFit.__call__), make("q_seed", "L0", "curve", "share"), (), 10.0
    ),
    "shape_feedback": Law(per_dtype(shape_feedback, followed), make("q_seed", "L0", "T", "y", "time"), (), 10.0),
    "controller_along_the_shape": Law(
        per_dtype(led, step_along_the_shape), make("q_seed", "L0", "T", "time", "x"), (0, 1, 2, 3, 4), 10.0
    ),
    "tendon_fractions": Law(per_dtype(routing, TendonRouting.fractions), make("L0")),
    "tendon_matrix": Law(per_dtype(routing, TendonRouting.matrix), make("L0")),
    "tendon_lengths": Law(per_dtype(routing, TendonRouting.lengths), make("q", "L0"), (0, 1)),
    "inertia": Law(per_dtype(arm_dynamics, SoftArmDynamics.inertia), make("q", "payload"), (0, 1)),
    "coriolis": Law(per_dtype(arm_dynamics, SoftArmDynamics.coriolis), make("q", "qdot", "payload"), (0, 1, 2)),
    "gravity": Law(per_dtype(arm_dynamics, SoftArmDynamics.gravity), make("q", "payload"), (0, 1)),
    "energy": Law(per_dtype(arm_dynamics, SoftArmDynamics.energy), make("q", "qdot", "payload"), (0, 1, 2), 10.0),
    "forward_dynamics": Law(
        per_dtype(arm_dynamics, SoftArmDynamics.forward), make("q", "qdot", "tau", "payload"), (0, 1, 2, 3), 10.0
    ),
}
for mode in ("position", "pose", "hierarchical"):
    estimator = feedback(mode)
    LAWS[f"feedback_{mode}"] = Law(estimator, make("q_seed", "L0", "T"), (0, 1, 2), 10.0)
    LAWS[f"sensitivity_{mode}"] = Law(estimator.sensitivity, make("q", "L0"), (0, 1), 10.0)


@pytest.mark.parametrize("name", LAWS)
def test_batching(name: str) -> None:
    law = LAWS[name]
    check_batching(law.op, law.inputs, shared=law.shared, scale=law.scale)


@pytest.mark.parametrize("name", LAWS)
def test_rows_do_not_mix(name: str) -> None:
    law = LAWS[name]
    for dtype in FLOATS:
        check_bad_row(law.op, law.inputs((4,), dtype, generator()))
