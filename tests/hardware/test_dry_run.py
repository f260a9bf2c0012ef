"""A dry run looks and reckons, and moves nothing."""

from __future__ import annotations

import numpy as np

from apcc_torch.hardware.clock import VirtualClock
from apcc_torch.hardware.dry_run import DryRunActuator
from apcc_torch.hardware.stops import StopReason
from fake_devices import FakeActuator, Fault, Faults
from fake_runs import fake_run


def test_nothing_reaches_the_motors_and_the_record_says_what_would_have() -> None:
    real = fake_run([Fault("wild", 0.0)])
    clock = real.setup.clock
    assert isinstance(clock, VirtualClock)
    motors = FakeActuator(clock, Faults())
    dry = fake_run([Fault("wild", 0.0)], actuator=DryRunActuator(motors))
    assert dry.outcome.reason is StopReason.DURATION
    assert not motors.commands and not motors.torque and not motors.held and not motors.connected
    would = np.array([tick.sent for tick in dry.witness.ticks if tick.fresh])
    did = np.array([y for _, y, _ in real.actuator.commands])
    assert np.array_equal(would, did)
