"""A small arm and all that works on it: modules, their arguments, and calls of them that every tensor enters."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.adaptive_dynamics import AdaptiveDynamics
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.length_law import LawStep, LengthLaw
from apcc_torch.control.pid import TendonPID, TendonReference
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.control.task_controller import TaskController
from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import Task, TaskTarget
from apcc_torch.estimation.external_force import ForceBalance
from apcc_torch.estimation.pose_filter import PoseFilter
from apcc_torch.estimation.posture import Posture
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import HANGING, PCCBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.rod_dynamics import RodDynamics
from apcc_torch.model.static_body import StaticBody
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.simulation.dynamic import ClosedLoop
from apcc_torch.simulation.exact import ExactLoop, ExactState
from apcc_torch.simulation.kinematic import FeedbackLoop, FeedbackState
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.sensors import Draws, PoseSensors

D = torch.float64
URDF = """<robot name="rail"><link name="world"/><link name="flange"/>
<joint name="slide" type="prismatic"><parent link="world"/><child link="flange"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" velocity="0.5" effort="1"/></joint></robot>"""

# Two sections, three sensors, six tendons: each made anew, on the default device of the moment unless told otherwise.
WHERE: dict[str, torch.device | None] = {"device": None}


def some(*shape: int, seed: int = 0, scale: float = 1.0) -> Tensor:
    """Numbers that look random and are the same every time, on the default device."""
    count = torch.Size(shape).numel()
    return (scale * torch.sin(1.0 + 7.3 * (torch.arange(count, dtype=D, **WHERE) + 11.0 * seed))).reshape(shape)


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=D, **WHERE)


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=D, **WHERE)


def eye(n: int) -> Tensor:
    return torch.eye(n, dtype=D, **WHERE)


def lengths() -> Tensor:
    return numbers(0.2, 0.25)


def sensors() -> Tensor:
    return numbers(0.12, 0.2, 0.45)


def base() -> Tensor:
    return torch.tensor(HANGING, dtype=D, **WHERE)


def q(*rows: int) -> Tensor:
    return some(*rows, 6, scale=0.3) * numbers(1.0, 1.0, 0.05).repeat(2)


def qdot(*rows: int) -> Tensor:
    return some(*rows, 6, seed=1, scale=0.3) * numbers(1.0, 1.0, 0.05).repeat(2)


def backbone() -> PCCBackbone:
    return PCCBackbone(2, base())


def poses(*rows: int) -> Tensor:
    L0 = lengths() + numbers(-0.01, 0.012)
    return backbone().pose(q(*rows), L0, *decouple(sensors(), L0))


def feedback(**settings: Any) -> StateFeedback:
    settings = {"abscissae": sensors(), "max_iterations": 3, "min_iterations": 3, "angular_weight": 0.2, **settings}
    return StateFeedback(backbone(), settings.pop("abscissae"), **settings)


def routing(**given: Any) -> TendonRouting:
    anchors = numbers(0.2, 0.45).repeat_interleave(3)
    tensors = {
        "angles": 2.0 * some(6),
        "offsets": 0.02 + some(6, scale=0.005),
        "anchors": anchors + some(6, scale=0.01),
    }
    return TendonRouting(**{**tensors, **given})


def stiff() -> dict[str, Tensor]:
    return {
        "masses": numbers(0.2, 0.3),
        "axial_stiffness": numbers(50.0, 40.0),
        "bending_stiffness": numbers(0.4, 0.3),
        "damping_ratio": number(0.1),
        "base_rotation": base(),
        "gravity": number(9.81),
    }


def dynamics(**given: Any) -> SoftArmDynamics:
    return SoftArmDynamics(**{"lengths": lengths(), **stiff(), **given})


def twisted() -> dict[str, Tensor]:
    return {
        "torsional_stiffness": numbers(0.3, 0.2),
        "shear_stiffness": numbers(500.0, 400.0),
        "radius": number(0.02),
    }


def rod(**given: Any) -> RodDynamics:
    return RodDynamics(**{"lengths": lengths(), **stiff(), **twisted(), **given})


def solver(**settings: Any) -> InverseKinematics:
    return InverseKinematics(**{"K": 1.5 * eye(3), "null_gain": 0.2, **settings})


def law(**settings: Any) -> AdaptiveLaw:
    return AdaptiveLaw(2, **{"gamma": 2.0 * eye(2), "normalisation": 1.0, **settings})


def controller(kind: type[APCCController] = APCCController, **given: Any) -> APCCController:
    of = given.pop("feedback", None) or feedback()
    more = {
        "bounds": LengthBounds(lengths(), sensors(), reach="last"),
        "elongation_bound": 0.05,
        "routing": routing(),
        **given,
    }
    parts = (given.pop("inverse_kinematics", None) or solver(), given.pop("laws", None) or law())
    more = {name: value for name, value in more.items() if name not in ("inverse_kinematics", "laws")}
    return kind(of.backbone, of, SavitzkyGolay(3, 1), *parts, **more)


def arguments(of: Any, *rows: int) -> tuple[Any, Measurement, Target]:
    """A controller's, of arms under way."""
    state = of.initial_state(q(*rows), lengths().expand(*rows, 2), number(0.0).expand(rows).clone())
    seen = Measurement(poses(*rows), number(0.02).expand(rows).clone())
    return state, seen, Target(numbers(0.05, 0.02, -0.4).expand(*rows, 3), numbers(0.1, 0.0, 0.0).expand(*rows, 3))


def controlled(of: Any, *rows: int) -> Any:
    later, command = of(*arguments(of, *rows))
    return command.qdot, command.q_d, command.y, later.pi_hat, command.feedback.q_bar


def law_step(of: LengthLaw) -> Any:
    """The law's speed on arms whose sensors are not where the model has them."""
    estimator = feedback()
    inference = estimator.infer(q(), lengths(), poses())
    chain, dq_dpi = estimator.chain_and_sensitivity(inference, torch.Size())
    seen = {"q_bar": inference.feedback.q_bar, "pi_hat": lengths(), "qdot": qdot(), "e": some(3, scale=0.01)}
    more = {"dt": number(0.02), "T": poses(), "abscissae": sensors(), "chain": chain, "dq_dpi": dq_dpi}
    step = LawStep(estimator.backbone, inference, **seen, **more)
    memory = of.initial_memory(q(), lengths())
    for _ in range(3):
        speed, memory = of.speed(step, memory)
    return speed


def balance(**settings: Any) -> ForceBalance:
    return ForceBalance(StaticBody(backbone(), 1.0, 10.0, 0.08), routing(), feedback(), **settings)


def posture() -> Posture:
    return Posture(q(), lengths(), -0.5 - some(6).abs(), qdot(), number(0.1))


def scalars(**values: float) -> dict[str, Tensor]:
    return {name: number(value) for name, value in values.items()}


def kinematics(of: KinematicModel) -> Any:
    at = some(of.n, scale=0.2)
    return (*of.tip_and_jacobian(at, lengths()), of.pose(at, lengths(), *decouple(sensors(), lengths())))


def pulled(of: TendonRouting) -> Any:
    return of.matrix(lengths())


def moved(of: SoftArmDynamics) -> Any:
    return of(q(), qdot(), some(6, scale=0.1))


def filtered(of: SavitzkyGolay) -> Any:
    state = of.initial_state(q(), number(0.0))
    for k in range(3):
        state, rate = of(state, q() * (1.0 + 0.1 * k * k), number(0.01 * k))
    return rate


def carried(of: PoseFilter) -> Any:
    state, seen = of.initial_state(q(), 3), torch.ones(3, dtype=torch.bool, **WHERE)
    for k in range(2):
        at = (1.0 + 0.2 * k) * q()
        seen_poses = backbone().pose(at, lengths(), *decouple(sensors(), lengths()))
        state, T = of(state, seen_poses, seen, seen, number(0.01))
        points = backbone().material_points(lengths(), *decouple(sensors(), lengths()))
        state = of.moved(state, backbone(), points, at, 0.1 * q())
    return T, state.T


def solved(of: InverseKinematics) -> Any:
    e, v = some(3, scale=0.01), some(3, seed=2, scale=0.1)
    return of(some(3, 6, seed=3), e, v, q(), number(0.01))


def learnt(of: AdaptiveDynamics) -> Any:
    Y, measured = some(6, 5, scale=0.1), some(6, 5, seed=1, scale=0.1)
    estimate = of.initial_estimate(q())
    return of(estimate, Y, qdot(), measured, some(6, scale=0.1), number(0.02)).theta_hat


def stacked(of: TaskStack) -> Any:
    targets = [TaskTarget(numbers(0.1, 0.0, -0.4))]
    return of(of.rates(backbone(), q(), lengths(), targets), qdot())


def asked(of: Task) -> Any:
    T, J_b = backbone().pose_and_body_jacobian(q(), lengths(), *decouple(sensors(), lengths()))
    return tuple(of(T[-1], J_b[-1], TaskTarget(numbers(0.1, 0.0, -0.4), R_d=base())))


def advanced(of: Plant) -> Any:
    now = of.straight((2,))
    return of.advance(now, TendonReference(now.z + 1e-3, now.z), 0.005, 0).arm


def judged(of: SensorGate) -> Any:
    state = of.initial_state(poses(), number(0.0))
    return of(state, poses(), torch.ones(3, dtype=torch.bool, **WHERE), number(1.0))[1]


def exact(of: ExactLoop) -> Any:
    return of(ExactState(q(), lengths()), number(0.3))[0]


def measured(of: FeedbackLoop) -> Any:
    now = FeedbackState(q(), of.controller.initial_state(q(), lengths()), of.sensors.initial_state(of.poses(q())))
    later = of(now, number(0.3), Draws(None, None))[0]
    return later.q, later.controller.pi_hat


def looped(of: ClosedLoop) -> Any:
    now = of.start(of.plant.straight((2,)), lengths())
    return of(now, number(0.3), torch.tensor(0, **WHERE), Draws(None, None))[0].plant.arm


def sensed(of: PoseSensors) -> Any:
    return of.sense(of.initial_state(poses()), poses(), None, Draws(some(3, 6), 0.5 + 0.5 * some(3)))[1].T


def pid(of: TendonPID) -> Any:
    z, y, ydot, y_d, ydot_d = (some(6, seed=i, scale=0.01) for i in range(5))
    return of(z, y, ydot, y_d, ydot_d), of.integrate(z, y, y_d, 0.1)


def near(of: Any) -> Any:
    return of(some(4, 3, scale=0.3))


def with_tasks(of: TaskController) -> Any:
    state, seen, target = arguments(of)
    return of(state, seen, target._replace(tasks=(TaskTarget(R_d=base()),)))[1].q_d
