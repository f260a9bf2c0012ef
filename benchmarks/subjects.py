"""What is timed: the toolkit's control step, dynamics and closed loop, on the paper's arm."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from math import pi
from typing import Any

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
    decouple,
)
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.trajectory import SetPoint, SineTrajectory
from apcc_torch.model.backbone import HANGING
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.layout import laid_out
from apcc_torch.native.structure import flattened, rebuilt
from apcc_torch.native.trace import traced
from apcc_torch.simulation.dynamic import DynamicLog, DynamicSettings, simulate_dynamic
from apcc_torch.simulation.kinematic import start_configuration
from apcc_torch.simulation.plant import Plant
from apcc_torch.simulation.sensors import PoseSensors

LENGTHS = (0.105, 0.255, 0.24)
SENSORS = (0.105, 0.36, 0.6)
PLANT = (0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12)
GUESS = (0.12, 0.28, 0.27)
RATE = 250.0


def controller(dtype: torch.dtype, tendons: bool = True) -> APCCController:
    """The A-PCC controller with poses, up to 7 iterations, the estimator-aware law, and tendons."""
    backbone = PCCBackbone(3, torch.tensor(HANGING, dtype=dtype))
    sensors = torch.tensor(SENSORS, dtype=dtype)
    return APCCController(
        backbone,
        StateFeedback(backbone, sensors),
        SavitzkyGolay(15, 2),
        InverseKinematics(1.8, null_gain=0.2),
        AdaptiveLaw(3, 1.0, normalisation=10.0),
        bounds=LengthBounds(torch.tensor(LENGTHS, dtype=dtype), sensors, lower=None, upper=None, reach="last"),
        routing=rack_routing(sensors) if tendons else None,
        elongation_bound=0.08 if tendons else None,
    )


def shipped(dtype: torch.dtype) -> APCCController:
    """The controller that ships, with its law of the shape."""
    arm = Arm(lengths=list(LENGTHS), sensors=list(SENSORS))
    return APCCController.for_arm(arm, K=1.8, elongation_bound=0.08).to(dtype)


def steps(
    batch: int, dtype: torch.dtype, count: int, made: Callable[[torch.dtype], APCCController] = controller
) -> tuple[APCCController, list[tuple[Any, ...]]]:
    """The controller, and its arguments at `count` successive steps of section V-A's loop."""
    c = made(dtype)
    lengths = torch.tensor(LENGTHS, dtype=dtype)
    path = SineTrajectory(
        torch.tensor([0.0, 0.0, -0.5], dtype=dtype), torch.tensor([0.5, 0.3, 0.1], dtype=dtype), 0.2 * pi
    )
    zero = torch.zeros((), dtype=dtype)
    start = start_configuration(c.backbone, lengths, path(zero).x_d)
    q = start.expand(batch, 9) if batch > 1 else start
    state = c.initial_state(q, torch.tensor(GUESS, dtype=dtype))
    places = decouple(torch.tensor(SENSORS, dtype=dtype), lengths)
    inputs: list[tuple[Any, ...]] = []
    for k in range(count):
        time = zero + k / RATE
        inputs.append((state, Measurement(c.backbone.pose(q, lengths, *places), time), path(time)))
        state, command = c(*inputs[-1])
        q = q + command.qdot / RATE
    return c, inputs


def one_row(item: Any, batch: int) -> Any:
    """The first row of arguments of a batch."""
    leaves = [leaf[0] if batch > 1 and leaf.dim() and leaf.shape[0] == batch else leaf for leaf in flattened(item)]
    return rebuilt(item, iter(leaves))


def dynamics(n: int, dtype: torch.dtype) -> SoftArmDynamics:
    """The arm of section V-B with n sections."""
    return arm_of(torch.tensor(PLANT, dtype=dtype) if n == 6 else torch.full((n,), 0.6 / n, dtype=dtype))


def arm_of(lengths: Tensor) -> SoftArmDynamics:
    """An arm of these sections, m, of the material of section V-B, of 1 kg."""
    axial, bending = scaled_stiffness(lengths)
    base = torch.tensor(HANGING, dtype=lengths.dtype)
    return SoftArmDynamics(lengths, lengths / lengths.sum(), axial, bending, damping_ratio=0.1, base_rotation=base)


def soromox(arm: SoftArmDynamics) -> Any:
    """SoRoMoX's model of an arm; None where it is not installed. It is imported only here: it takes seconds to load."""
    return importlib.import_module("peer_soromox").Peer(arm) if importlib.util.find_spec("soromox") else None


def states(n: int, batch: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """q, qdot and tau of a batch, without a leading dimension for one row."""
    generator = torch.Generator().manual_seed(0)
    q, qdot = (0.1 * torch.randn(batch, 3 * n, dtype=torch.float64, generator=generator) for _ in range(2))
    q[:, 2::3] *= 0.02
    given = (q.to(dtype), qdot.to(dtype), torch.zeros(batch, 3 * n, dtype=dtype))
    return given if batch > 1 else tuple(value[0] for value in given)  # type: ignore[return-value]


def plant(rows: int) -> Plant:
    """The true arm of section V-B with payloads from 0 to 0.5 kg."""
    payload = torch.linspace(0.0, 0.5, rows, dtype=torch.float64)
    tendons = rack_routing(torch.tensor(SENSORS, dtype=torch.float64))
    return Plant(dynamics(6, torch.float64), tendons, None, payload, settle=0.0)


def closed_loop(rows: int, duration: float, compile: str) -> DynamicLog:
    """Section V-B's closed loop: 100 Hz control, two plant steps a period."""
    target = SetPoint(torch.tensor([0.215, 0.03, -0.515], dtype=torch.float64).expand(rows, 3))
    settings = DynamicSettings(duration=duration, control_rate=100.0, compile=compile)
    first = torch.tensor(LENGTHS, dtype=torch.float64)
    return simulate_dynamic(plant(rows), controller(torch.float64), PoseSensors(), target, first, settings)


def floor(function: NativeFunction) -> dict[str, float]:
    """Operations and bytes of one row: what no implementation of the same formulas can do without."""
    trace = traced(function.traced, function.example)
    moved = [*trace.inputs, *trace.outputs]
    return {
        "operations": float(laid_out(trace).operations(trace.scalars)),
        "bytes": float(sum(torch.Size(leaf.shape).numel() * leaf.dtype.itemsize for leaf in moved)),
    }
