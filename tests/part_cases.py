"""Every public module as a case for tests of all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch.control.adaptation import NormalisedLaw
from apcc_torch.control.adaptive_dynamics import AdaptiveDynamics
from apcc_torch.control.clearance import ClearanceCost
from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.lookahead_controller import LookaheadController
from apcc_torch.control.lookahead_settings import LookaheadSettings
from apcc_torch.control.obstacles import Capsule, HalfSpace, Sphere
from apcc_torch.control.pid import TendonPID
from apcc_torch.control.pressure import PressureControl
from apcc_torch.control.shape_law import ShapeLaw
from apcc_torch.control.task_controller import TaskController
from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import Task
from apcc_torch.control.tendon_limits import TendonLimits
from apcc_torch.control.trajectory import SetPoint, SineTrajectory
from apcc_torch.estimation.contact import ContactSearch
from apcc_torch.estimation.load_from_shape import LoadFromShape
from apcc_torch.estimation.momentum_observer import MomentumObserver
from apcc_torch.estimation.pose_filter import PoseFilter
from apcc_torch.estimation.posture import TendonMechanics
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.estimation.soft_window import SoftWindow
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.chambers import ChamberForce
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from apcc_torch.model.dynamics_regressor import DynamicsRegressor
from apcc_torch.model.friction import TendonTransmission
from apcc_torch.model.mount import MountedArm, RigidMount
from apcc_torch.model.static_body import StaticBody
from apcc_torch.part import Part
from apcc_torch.simulation.curvature_sensors import CurvatureSensors
from apcc_torch.simulation.divergence import Divergence
from apcc_torch.simulation.dynamic import ClosedLoop
from apcc_torch.simulation.events import ArmEvents
from apcc_torch.simulation.exact import ExactLoop
from apcc_torch.simulation.inertial_units import InertialUnits
from apcc_torch.simulation.kinematic import FeedbackLoop
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.rod_plant import RodPlant
from apcc_torch.simulation.sensors import PoseSensors
from apcc_torch.simulation.valves import Valves
from chambered import chambered, pressed, pushing, together
from followed import along, fit, fitted, followed, hung, led, loaded
from laws import generator
from parts import (
    URDF,
    WHERE,
    advanced,
    arguments,
    asked,
    backbone,
    balance,
    base,
    carried,
    controlled,
    controller,
    dynamics,
    exact,
    eye,
    feedback,
    filtered,
    judged,
    kinematics,
    law,
    law_step,
    learnt,
    lengths,
    looped,
    measured,
    moved,
    near,
    number,
    numbers,
    pid,
    poses,
    posture,
    pulled,
    q,
    qdot,
    rod,
    routing,
    scalars,
    sensed,
    sensors,
    solved,
    solver,
    some,
    stacked,
    stiff,
    twisted,
    with_tasks,
)


def ahead_of() -> dict[str, Any]:
    settings = LookaheadSettings(samples=4, knots=2, steps=2, batch=2, spheres=((0.1, 0.0, -0.3, 0.05),))
    return {"of": Arm(lengths=[0.2, 0.25]), "lookahead": settings}


def looked_ahead(of: Any, *rows: int) -> Any:
    state, measurement, target = arguments(of, *rows)
    later, command = of(of.look_ahead(state, target), measurement, target)
    return command.qdot, command.q_d, command.y, later.ahead.r, of.look_ahead(later, target).ahead.knots


class Case(NamedTuple):
    """A module of tensors by the names of its arguments, a call of it, and settings that another one differs in."""

    make: Callable[..., Part]
    call: Callable[[Any], Any]
    tensors: Callable[[], dict[str, Tensor]] = dict
    other: Callable[[], dict[str, Any]] = dict


CASES: dict[str, Case] = {
    "PCCBackbone": Case(lambda **t: PCCBackbone(2, **t), kinematics, lambda: {"base_rotation": base()}),
    "AffineBackbone": Case(
        lambda **t: AffineBackbone(2, **{"rods": 2, **t}), kinematics, lambda: {"base_rotation": base()}
    ),
    "ConstantStrainBackbone": Case(
        lambda **t: ConstantStrainBackbone(2, **t), kinematics, lambda: {"base_rotation": base()}
    ),
    "TendonRouting": Case(
        routing,
        pulled,
        lambda: {
            "angles": some(6),
            "offsets": 0.02 + some(6, scale=0.01),
            "anchors": 0.3 + some(6, scale=0.1),
            "starts": 0.05 + some(6, scale=0.03),
        },
    ),
    "TendonRouting, independent": Case(
        lambda **t: routing(layout="independent", **t), pulled, lambda: {"anchors": 0.3 + some(6, scale=0.1)}
    ),
    "SoftArmDynamics": Case(
        dynamics, moved, lambda: {"lengths": lengths(), **stiff()}, lambda: {"n_quadrature": 3, "gravity": 1.6}
    ),
    "SoftArmDynamics with damping": Case(dynamics, moved, lambda: {"damping": 0.1 + some(6).abs()}),
    "RodDynamics": Case(
        rod,
        lambda of: of(some(12, scale=0.01), some(12, seed=1, scale=0.05), some(12, seed=2, scale=0.01)),
        lambda: {"lengths": lengths(), **stiff(), **twisted()},
    ),
    "RodDynamics with damping": Case(
        rod,
        lambda of: of(some(12, scale=0.01), some(12, seed=1, scale=0.05), some(12, seed=2, scale=0.01)),
        lambda: {"damping": 0.1 + some(12).abs()},
    ),
    "DynamicsRegressor": Case(
        lambda **t: DynamicsRegressor(routing(), **t),
        lambda of: of(q(), qdot(), qdot(), q(), lengths()),
        lambda: {"base_rotation": base()},
        lambda: {"gravity": 1.6, "n_quadrature": 3},
    ),
    "TendonTransmission": Case(
        lambda **t: TendonTransmission(routing(), **{"friction": 0.2, **t}),
        lambda of: of(-some(6).abs(), q(), qdot(), lengths()),
        other=lambda: {"friction": 0.0},
    ),
    "StaticBody": Case(
        lambda **t: StaticBody(backbone(), **{"density": 1.0, "axial": 10.0, "bending": 0.08, **t}),
        lambda of: of.rest_force(q(), lengths()),
        lambda: scalars(density=1.0, axial=10.0, bending=0.08, gravity=9.0),
        lambda: {"n_quadrature": 3, "rest_bend": 0.1 * some(2, 2)},
    ),
    "TendonMechanics": Case(
        lambda **t: TendonMechanics(**{"stiffness": 1e3 + some(6).abs(), "friction": number(0.1), **t}),
        lambda of: (
            of.forces(0.01 + some(6).abs(), some(6)),
            of.rubbed(routing().matrix(lengths()), routing(), q(), lengths(), some(6)),
        ),
        lambda: {"stiffness": 2e3 + some(6).abs(), "friction": number(0.2)},
    ),
    "MountedArm": Case(
        lambda **t: MountedArm(RigidMount(URDF, "flange", **t), backbone()),
        lambda of: of.tip_pose(torch.cat((numbers(0.1), q())), lengths()),
        lambda: {"placement": eye(4)},
    ),
    "StateFeedback": Case(
        feedback,
        lambda of: of(0.9 * q(), lengths(), poses())[:3],
        lambda: {"abscissae": sensors(), **scalars(angular_weight=0.2)},
        lambda: {"mode": "position", "max_iterations": 2, "min_iterations": 1, "damping": 1e-4},
    ),
    "SavitzkyGolay": Case(
        lambda **t: SavitzkyGolay(**{"window": 3, "order": 2, **t}),
        filtered,
        lambda: {"window": torch.tensor(3.0)},
        lambda: {"window": 5, "order": 1, "period": 0.02},
    ),
    "SoftWindow": Case(
        lambda **t: SoftWindow(**{"order": 1, **t}), filtered, lambda: {"weights": numbers(0.2, 0.5, 1.0)}
    ),
    "PoseFilter": Case(
        lambda **t: PoseFilter(**{"delay": 1, **t}),
        carried,
        lambda: scalars(angular_time=0.1, linear_time=0.05, follow=0.7),
        lambda: {"delay": 0, "follow": 0.1},
    ),
    "SensorGate": Case(
        lambda **t: SensorGate(**{"abscissae": sensors(), **t}),
        judged,
        lambda: {"abscissae": sensors(), "max_bend": numbers(1.0, 1.1, 1.2), "max_twist": numbers(0.5, 0.5, 0.6)},
        lambda: {"reach": 0.1},
    ),
    "ForceBalance": Case(
        balance,
        lambda of: (of.imbalance(posture()), of.force(posture()).covariance),
        lambda: scalars(damping_ratio=0.1, tendon_damping=10.0),
        lambda: {"tip": 0.3, "limit": 1.0},
    ),
    "ContactSearch": Case(
        lambda **t: ContactSearch(balance(), **{"candidates": 5, "refinements": 1, **t}),
        lambda of: of(posture()).interval,
        other=lambda: {"candidates": 7, "longest": 0.2},
    ),
    "MomentumObserver": Case(
        lambda **t: MomentumObserver(dynamics(), routing(), **t),
        lambda of: of(of(of.initial_state(q()), q(), qdot(), some(6), 0.01), 1.1 * q(), qdot(), some(6), 0.01).r,
        lambda: scalars(gain=10.0, tendon_damping=5.0),
    ),
    "LoadFromShape": Case(
        lambda **t: LoadFromShape(dynamics(), routing(), **{"abscissae": sensors(), "iterations": 2, **t}),
        lambda of: of(some(6, scale=1e-3), poses(), some(6)).load.covariance,
        lambda: {"abscissae": sensors()},
        lambda: {"iterations": 1, "step": 1.0},
    ),
    "LoadedShape": Case(
        loaded,
        hung,
        lambda: {
            "abscissae": sensors(),
            **scalars(position_noise=2e-3, angular_noise=0.03, tendon_noise=3e-3, bend=2.0, elongation=0.2),
            **scalars(load=0.4, load_rate=0.2, sag_time=0.1),
        },
        lambda: {"load": 0.1, "tendon_noise": 1e-2},
    ),
    "ArcFit": Case(
        fit,
        fitted,
        lambda: {"nominal": lengths(), **scalars(curve_noise=1e-3, length_prior=0.1)},
        lambda: {"length_prior": 0.5},
    ),
    "ShapeFeedback": Case(followed, along, lambda: scalars(curve_noise=1e-3), lambda: {"length_prior": 0.5}),
    "InverseKinematics": Case(
        solver,
        solved,
        lambda: {
            "K": 2.0 * eye(3),
            "null_weights": numbers(1.0, 2.0),
            "null_bends": numbers(0.2, -0.1),
            **scalars(damping=0.1, null_gain=0.3, epsilon=1e-2, null_step=0.01, null_speed=0.1, bend_rate=0.1),
        },
        lambda: {"K": 3.0, "null_gain": 0.0, "damping": 0.2},
    ),
    "AdaptiveLaw": Case(
        law,
        law_step,
        lambda: {"gamma": eye(2), **scalars(rate=1e-4, normalisation=2.0)},
        lambda: {"regressor": "partial", "dead_zone": 1.0},
    ),
    "NormalisedLaw": Case(
        lambda **t: NormalisedLaw(2, **{"gamma": 3.0 * eye(2), "dead_zone": 0.0, **t}),
        law_step,
        lambda: {"gamma": eye(2)},
        lambda: {"normalisation": 1.0},
    ),
    "ShapeLaw": Case(
        lambda **t: ShapeLaw(lengths(), feedback(), **t),
        law_step,
        lambda: scalars(time_constant=0.5),
        lambda: {"time_constant": 0.2},
    ),
    "LengthBounds": Case(
        lambda **t: LengthBounds(**{"nominal": lengths(), "abscissae": sensors(), "reach": "last", **t}),
        lambda of: of(0.5 * lengths()),
        lambda: {"nominal": lengths(), "abscissae": sensors(), "lower": numbers(0.7, 0.8), "upper": numbers(1.2, 1.3)},
        lambda: {"reach": "free", "upper": None},
    ),
    "AdaptiveDynamics": Case(
        lambda **t: AdaptiveDynamics(
            **{"nominal": numbers(0.08, 10.0, 200.0, 0.1, 1.0), "deviation": numbers(0.02, 3.0, 50.0, 0.3, 0.1), **t}
        ),
        learnt,
        lambda: {"nominal": numbers(0.08, 10.0, 200.0, 0.1, 1.0), "deviation": numbers(0.02, 3.0, 50.0, 0.3, 0.1)},
        lambda: {"memory": 1.0, "prediction": False},
    ),
    "TaskIntegral": Case(
        TaskIntegral,
        lambda of: of(some(3, scale=1e-3), some(3, scale=1e-3), number(0.1)),
        lambda: scalars(gain=0.5, reach=2e-3),
        lambda: {"gain": 0.1},
    ),
    "TendonPID": Case(
        TendonPID, pid, lambda: scalars(K_P=10.0, K_I=2.0, K_D=3.0, force_limit=0.05), lambda: {"force_limit": 1e-3}
    ),
    "PressureControl": Case(
        lambda **t: PressureControl(dynamics(), chambered(), pushing(), together(), **t),
        pressed,
        lambda: scalars(K_P=0.5, K_I=1.0, K_D=0.1, rate_time=0.02, bend_rate=0.05, windup_time=0.2),
        lambda: {"K_P": 0.7, "share": False},
    ),
    "ChamberForce": Case(
        lambda **t: ChamberForce(**{"area": 1e-4 + 1e-4 * some(6).abs(), **t}),
        lambda of: (of(1e4 * some(6).abs()), of.pressure(some(6).abs()), of.within(1e5 * some(6))),
        lambda: {
            "area": 2e-4 + 1e-4 * some(6).abs(),
            "growth": 1e-6 * some(6).abs(),
            "rest": 1e4 + 1e3 * some(6).abs(),
            "least": 1e3 * some(6).abs(),
            "most": 8e4 + 1e3 * some(6).abs(),
        },
    ),
    "Valves": Case(
        lambda **t: Valves(pushing(), **t),
        lambda of: of.forces(of.after(of.at_rest, 1e5 * some(6).abs(), 0.01)),
        other=lambda: {"time": 0.1},
    ),
    "SineTrajectory": Case(
        lambda **t: SineTrajectory(**{"r_0": some(3), "A": some(3, seed=1), "omega": 1.0, **t}),
        lambda of: tuple(of(number(0.7)))[:2],
        lambda: {"r_0": some(3), "A": some(3, seed=1), **scalars(omega=2.0)},
    ),
    "SetPoint": Case(lambda **t: SetPoint(**t), lambda of: of(number(0.0)).x_d, lambda: {"x_d": some(3)}),
    "Capsule": Case(
        lambda **t: Capsule(**{"radius": 0.1, **t}),
        near,
        lambda: {"start": some(3), "end": some(3, seed=1), **scalars(radius=0.1)},
    ),
    "Sphere": Case(lambda **t: Sphere(**{"radius": 0.1, **t}), near, lambda: {"centre": some(3)}),
    "HalfSpace": Case(HalfSpace, near, lambda: {"point": some(3), "normal": some(3, seed=1)}),
    "ClearanceCost": Case(
        lambda **t: ClearanceCost(
            [Sphere(numbers(0.0, 0.0, -0.4), 0.05)], **{"points": 6, "self_separation": 0.2, **t}
        ),
        lambda of: of(backbone(), q(), lengths()),
        lambda: scalars(radius=0.1, activation=0.2),
        lambda: {"activation": 0.3},
    ),
    "Task": Case(lambda **t: Task("pose", **t), asked, lambda: {"gain": eye(6), **scalars(weight=2.0)}),
    "TaskStack": Case(
        lambda **t: TaskStack([Task("position", gain=eye(3))], **t),
        stacked,
        lambda: {"coordinate_weights": 1.0 + some(6).abs(), **scalars(damping=0.1)},
    ),
    "TendonLimits": Case(
        TendonLimits,
        lambda of: (*of.rates(some(6, scale=0.1), number(0.01)), of.held(some(6, scale=0.1))),
        lambda: {
            "lower": -0.05 - some(6, scale=0.01),
            "upper": 0.05 + some(6, scale=0.01),
            "rate": 0.1 + some(6).abs(),
        },
    ),
    "Divergence": Case(
        lambda **t: Divergence(**t),
        lambda of: of.now(number(0.5), some(4, 3), some(4).abs()),
        other=lambda: {"shape": 5.0},
    ),
    "PoseSensors": Case(
        lambda **t: PoseSensors(**t),
        sensed,
        lambda: scalars(position_noise=1e-3, angular_noise=1e-2),
        lambda: {"delay": 1},
    ),
    "InertialUnits": Case(
        lambda **t: InertialUnits(**t),
        lambda of: of(of.initial_state(some(3), generator()), poses()[..., :3, :3], some(3, 4))[1],
        lambda: scalars(tilt_noise=1e-2, mounting=2e-2, heading=0.1, heading_drift=1e-2),
        lambda: {"heading": 0.3},
    ),
    "CurvatureSensors": Case(
        lambda **t: CurvatureSensors(**t),
        lambda of: of(of.initial_state(some(2, 2), 1, generator()), some(2, 2), some(2, 2))[1],
        lambda: scalars(noise=0.1, offset=0.2),
        lambda: {"noise": 0.3},
    ),
    "Plant": Case(
        lambda **t: Plant(dynamics(), routing(), TendonPID(), **{"payload": numbers(0.1, 0.2), **t}),
        advanced,
        lambda: {"payload": numbers(0.1, 0.2), **scalars(tendon_damping=100.0, backlash=1e-3)},
    ),
    "RodPlant": Case(
        lambda **t: RodPlant(rod(), routing(), TendonPID(), **{"payload": numbers(0.1, 0.2), **t}),
        advanced,
        lambda: {"payload": numbers(0.1, 0.2), **scalars(tendon_damping=100.0)},
    ),
    "ArmEvents": Case(
        lambda **t: ArmEvents(4, **{"growth": numbers(0.1, 0.2), "taken_at": 0.2, **t}),
        lambda of: (of.payload(numbers(0.1, 0.2), numbers(0.1, 0.3)), of.growth_at(numbers(0.1, 0.3))),
        lambda: {"growth": numbers(0.1, 0.2), **scalars(taken=0.1, growth_from=0.05, growth_over=1.0)},
        lambda: {"taken": -0.05},
    ),
    "ExactLoop": Case(
        lambda **t: ExactLoop(controller(), trajectory=SetPoint(some(3)), dt=0.1, **{"pi": lengths(), **t}),
        exact,
        lambda: {"pi": lengths()},
    ),
    "FeedbackLoop": Case(
        lambda **t: FeedbackLoop(controller(), trajectory=SetPoint(some(3)), dt=0.1, **{"pi": lengths(), **t}),
        measured,
        lambda: {"pi": lengths()},
    ),
    "ClosedLoop": Case(
        lambda **t: ClosedLoop(
            Plant(dynamics(), routing(), TendonPID(), numbers(0.1, 0.2), substeps=1),
            controller(),
            PoseSensors(),
            SetPoint(some(3)),
            0.01,
            **t,
        ),
        looped,
        lambda: {"abscissae": 0.9 * sensors()},
    ),
    "APCCController": Case(
        lambda **t: controller(pose_filter=PoseFilter(0.1, 0.1), integral=TaskIntegral(), **t),
        controlled,
        lambda: scalars(bend_bound=0.2, elongation_bound=1e-3),
        lambda: {"adaptive": False, "reference_damping": 0.1},
    ),
    "APCCController along the shape": Case(
        led, controlled, lambda: scalars(time_constant=0.5), lambda: {"time_constant": 0.2}
    ),
    "TaskController": Case(
        lambda **t: controller(TaskController, tasks=[Task("orientation", 0.2, eye(3), level=1)], **t),
        with_tasks,
        other=lambda: {"bend_bound": 0.1},
    ),
    "LookaheadController": Case(
        lambda **t: controller(LookaheadController, **ahead_of(), **t).to(**WHERE),
        looked_ahead,
        other=lambda: {"bend_bound": 0.1},
    ),
    "CompositeController": Case(
        lambda **t: CompositeController(controller(), **t),
        lambda of: of(*arguments(of))[1].force,
        other=lambda: {"stiffness": 1.0, "force_limit": 0.1},
    ),
}
