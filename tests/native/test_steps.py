"""The toolkit's own steps as machine code: the controller, both closed loops, forward dynamics."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch import AdaptiveLaw, APCCController, InverseKinematics, PCCBackbone, SavitzkyGolay, StateFeedback
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.pid import TendonPID
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.control.tendon_limits import SolverStatus
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.estimation.pose_filter import PoseFilter
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import HANGING
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from apcc_torch.native.compiled import compiled
from apcc_torch.native.function import NativeFunction
from apcc_torch.simulation.dynamic import ClosedLoop
from apcc_torch.simulation.exact import simulate_exact
from apcc_torch.simulation.kinematic import simulate_feedback
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.sensors import PoseSensors
from laws import generator, normal, worst

D = torch.float64
BASE = torch.tensor(HANGING, dtype=D)
# Not at a sensor: there the estimate's derivative jumps, and rounding decides which side is seen.
PI_HAT = torch.tensor([0.11, 0.27, 0.24], dtype=D)
X = torch.tensor([0.105, 0.36, 0.6], dtype=D)
PI = torch.tensor([0.105, 0.255, 0.24], dtype=D)


def controller(mode: str = "pose", iterations: int = 2, **parts: Any) -> APCCController:
    backbone = PCCBackbone(3, BASE)
    return APCCController(
        backbone,
        StateFeedback(backbone, X, mode, max_iterations=iterations),
        SavitzkyGolay(5, 2),
        parts.pop("inverse_kinematics", InverseKinematics(1.5, null_gain=0.2)),
        parts.pop("laws", AdaptiveLaw(3, 1.0, normalisation=10.0, dead_zone=1e-4)),
        bounds=parts.pop("bounds", LengthBounds(PI, X, lower=None, upper=None, reach="last")),
        routing=rack_routing(X),
        elongation_bound=0.01,  # some rows are at it
        **parts,
    )


def step_inputs(c: APCCController, rows: int) -> tuple[Any, Measurement, Target]:
    """A state that is under way, and what the sensors see a little later."""
    rng = generator(3)
    q = 0.3 * normal((rows, 9), D, rng)
    q[:, 2::3] *= 0.05
    state = c.initial_state(q, PI_HAT * (1.0 + 0.02 * normal((rows, 3), D, rng)), torch.zeros((), dtype=D))
    lengths = torch.tensor([0.105, 0.255, 0.24], dtype=D)
    target = Target(torch.tensor([0.1, 0.1, -0.5], dtype=D), torch.zeros(3, dtype=D))
    for k in range(4):
        moved = q + 0.01 * k
        measurement = Measurement(c.backbone.pose(moved, lengths, *decouple(X, lengths)), torch.tensor(0.01 * k))
        measurement = measurement._replace(time=measurement.time.to(D))
        if k < 3:
            state, _ = c(state, measurement, target)
    return state, measurement, target


def one(item: Any, row: int = 0) -> Any:
    """One row of nested tuples whose tensors all have one leading dimension, or none."""
    if isinstance(item, Tensor):
        return item[row] if item.dim() and item.shape[0] == 7 else item
    if item is None:
        return None
    parts = [one(part, row) for part in item]
    return type(item)(*parts) if hasattr(item, "_fields") else tuple(parts)


LAW = AdaptiveLaw(3, 1.0, normalisation=10.0, dead_zone=1e-4)
PARTIAL = AdaptiveLaw(3, 0.5, regressor="partial")


@pytest.mark.parametrize(
    ("mode", "parts", "tolerance"),
    [
        ("pose", {}, 1e-12),
        ("position", {"laws": [LAW, PARTIAL]}, 1e-12),
        ("pose", {"pose_filter": PoseFilter(0.05, 0.01, delay=2), "integral": TaskIntegral(1.0, 0.2)}, 1e-12),
        # Its second least-squares problem is nearly singular: one rounding of its input moves the eager step as much.
        ("hierarchical", {"velocity": "commanded"}, 1e-10),
    ],
)
def test_the_controller_equals_its_eager_self(mode: str, parts: dict[str, Any], tolerance: float) -> None:
    c = controller(mode, **parts)
    inputs = step_inputs(c, 7)
    with torch.no_grad():
        want = c(*inputs)
        assert set(want[1].limits.tolist()) == {int(SolverStatus.FREE), int(SolverStatus.LIMITED)}
        step = NativeFunction(c, one(inputs))
        assert worst(step(*inputs), want) < tolerance
        # Plain numbers instead of lanes are another library; one case shows them.
        for row in () if parts or mode != "pose" else (0, 6):
            alone = step(*one(inputs, row))
            assert worst(alone, one(want, row)) < tolerance


def test_gains_of_each_row() -> None:
    K = torch.linspace(0.5, 2.0, 7, dtype=D)
    gamma = torch.diag_embed(torch.linspace(0.1, 3.0, 7, dtype=D).unsqueeze(-1).expand(7, 3))
    solver = InverseKinematics(torch.diag_embed(K.unsqueeze(-1).expand(7, 3)), null_gain=0.05)
    law = AdaptiveLaw(3, gamma, dead_zone=torch.linspace(0.0, 1e-3, 7, dtype=D))
    c = controller(inverse_kinematics=solver, laws=law, bounds=None)
    inputs = step_inputs(c, 7)
    with torch.no_grad():
        assert worst(NativeFunction(c, one(inputs))(*inputs), c(*inputs)) < 1e-12


@pytest.mark.parametrize(("dropout", "tolerance"), [(0.0, 1e-11), (0.1, 5e-8)])
def test_the_dynamic_loop_equals_its_eager_self(dropout: float, tolerance: float) -> None:
    # Where sensors are missing the estimate is held by its damping alone, 1e-8, and rounding shows as much more: moved
    # by one rounding, the states below move the eager step by up to 8e-9.
    lengths = torch.tensor([0.11, 0.25, 0.24], dtype=D)
    arm = SoftArmDynamics(lengths, lengths, *scaled_stiffness(lengths), damping_ratio=0.1, base_rotation=BASE)
    payload = torch.linspace(0.0, 0.4, 5, dtype=D)
    plant = Plant(arm, rack_routing(X), TendonPID(), payload, 200.0, substeps=1)
    sensors = PoseSensors(1e-4, 1e-3, delay=1, dropout=dropout)
    loop = ClosedLoop(plant, controller(), sensors, SetPoint(torch.tensor([0.2, 0.05, -0.5], dtype=D)), 0.01)
    with torch.no_grad():
        example = loop.blank()
        step = compiled(loop, example, "aot", 5)
        assert isinstance(step, NativeFunction)
        now = loop.start(plant.settled(0.1, 0.005), PI_HAT)
        for k in range(8):
            draws = sensors.draw(now.sensors.queue[:, 0], generator(k))
            arguments = (now, torch.tensor(0.01 * k, dtype=D), torch.tensor(k), draws)
            now, row = loop(*arguments)
            assert worst(step(*arguments), (now, row)) < tolerance


def test_settling_is_one_call() -> None:
    lengths = torch.tensor([0.3, 0.3], dtype=D)
    arm = SoftArmDynamics(lengths, lengths, *scaled_stiffness(lengths), damping_ratio=0.1, base_rotation=BASE)
    plant = Plant(arm, rack_routing(lengths.cumsum(0)), TendonPID(), torch.linspace(0.0, 0.4, 3, dtype=D), 200.0)
    with torch.no_grad():
        assert worst(plant.settled(0.2, 0.005, "aot"), plant.settled(0.2, 0.005)) < 1e-11


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_forward_dynamics(dtype: torch.dtype) -> None:
    lengths = torch.tensor([0.11, 0.25, 0.24], dtype=D)
    arm = SoftArmDynamics(lengths, lengths, *scaled_stiffness(lengths), damping_ratio=0.1, base_rotation=BASE).to(dtype)
    q, qdot, tau = (0.2 * normal((13, 9), D, generator(k)).to(dtype) for k in range(3))
    with torch.no_grad():
        want = arm(q, qdot, tau)
        have = NativeFunction(arm, (q[0], qdot[0], tau[0]))(q, qdot, tau)
    torch.testing.assert_close(have, want, rtol=1e-10 if dtype == D else 2e-3, atol=1e-9 if dtype == D else 1e-2)


@pytest.mark.parametrize("loop", ["exact", "feedback"])
def test_section_v_a(loop: str) -> None:
    c = controller(laws=AdaptiveLaw(3, 1.0), bounds=None, velocity="commanded")
    run = {"exact": simulate_exact, "feedback": simulate_feedback}[loop]
    target = SetPoint(torch.tensor([0.05, 0.1, -0.55], dtype=D))
    with torch.no_grad():
        arguments = (c, PI, PI_HAT.expand(3, 3), target, 0.1, 50.0)
        have, want = run(*arguments, compile="aot"), run(*arguments)
    assert worst(have, want) < 1e-9
