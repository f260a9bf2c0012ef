"""Whole runs on the devices of `fake_devices`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch

from apcc_torch.composition.build import Builder
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.estimation.sensor_gate import SensorGate, SensorGateSettings
from apcc_torch.hardware.clock import VirtualClock
from apcc_torch.hardware.control import Control
from apcc_torch.hardware.guards import GuardSettings
from apcc_torch.hardware.limits import CommandLimits
from apcc_torch.hardware.mounts import Mounts
from apcc_torch.hardware.records import Observer, Outcome
from apcc_torch.hardware.runner import Runner
from apcc_torch.hardware.sensing import Sensing, SensingSettings, blank_frame
from apcc_torch.hardware.setup import LoopSettings, Setup
from apcc_torch.hardware.stop_request import StopRequest
from apcc_torch.model.abscissae import decouple
from apcc_torch.native import NativeFunction
from composed import composed
from fake_devices import N_TENDONS, FakeActuator, FakeSensor, FakeStep, Fault, Faults, Witness

RATE = 100.0
DURATION = 1.5
LIMITS = CommandLimits(N_TENDONS, lower=-0.03, upper=0.01, rate=0.2, step=0.003)
GUARDS = GuardSettings(effort_limit=50.0, effort_cap=200.0, slack_effort=1.0, slack_dwell=0.1, overruns=10)
SENSING = SensingSettings(max_age=0.06, stale=0.2, dropout=0.3, gate=SensorGateSettings())


@cache
def builder() -> Builder:
    """The objects of the paper's arm."""
    return Builder(composed("experiment=dynamic_single"))


@cache
def rest() -> np.ndarray:
    """(3, 4, 4) poses of the bodies on the straight hanging arm, m."""
    build = builder()
    pi_hat = build.first_estimate()
    straight = torch.zeros(3 * build.n_sections, dtype=torch.float64)
    poses: np.ndarray = build.backbone().pose(straight, pi_hat, *decouple(build.sensors_at(), pi_hat)).numpy()
    return poses


def sensing(mounts: Mounts | None = None, machine_code: bool = False, **changes: Any) -> Sensing:
    """What judges the frames of the paper's arm, by `SENSING` with changes."""
    settings = SENSING.changed(**changes)
    gate = SensorGate(builder().sensors_at(), settings.gate)
    judge = NativeFunction(gate, blank_frame(gate)) if machine_code else None
    return Sensing(gate, builder().base_rotation(), settings, mounts, judge)


@dataclass
class FakeRun:
    """A run that is over, with all its parts."""

    outcome: Outcome
    setup: Setup
    actuator: FakeActuator
    sensor: FakeSensor
    witness: Witness
    step: FakeStep


def fake_run(
    faults: Iterable[Fault] = (),
    guards: GuardSettings = GUARDS,
    limits: CommandLimits = LIMITS,
    observers: Sequence[Observer] = (),
    **changes: Any,
) -> FakeRun:
    """Runs to the end. Faults begin at times of the clock, which starts at 0; the run's own at about 0.1 s."""
    build = builder()
    clock, wrong, request = VirtualClock(), Faults(faults), StopRequest()
    controller = build.controller()
    pi_hat = build.first_estimate()
    actuator, sensor = FakeActuator(clock, wrong), FakeSensor(clock, wrong, rest())
    step = FakeStep(clock, wrong, request)
    target = SetPoint(torch.tensor([0.0, 0.15, -0.5], dtype=torch.float64))
    witness = Witness(clock, wrong)
    setup = Setup(
        actuator,
        sensor,
        sensing(),
        Control(controller, target, pi_hat, step),
        limits,
        guards,
        LoopSettings(rate=RATE, warm_up=2, hold=0.1),
        clock,
        DURATION,
        request,
        (witness, *observers),
    )
    setup = replace(setup, **changes)
    return FakeRun(Runner(setup).run(), setup, actuator, sensor, witness, step)
