"""The check of signs on devices in memory: a pull that is too strong, or unknown, ends it with torque off."""

from __future__ import annotations

import numpy as np
import pytest

from apcc_torch.errors import SafetyError
from apcc_torch.hardware.calibration_measurement import SignCheck
from apcc_torch.hardware.clock import VirtualClock
from apcc_torch.hardware.stop_request import StopRequest
from fake_devices import FakeActuator, FakeSensor, Fault, Faults
from fake_runs import LIMITS, rest


@pytest.mark.parametrize(
    ("kind", "said"), [("effort_peak", "tendon 5 pulled with 505 N"), ("effort_nan", "tendon 2 .*")]
)
def test_a_tendon_that_pulls_too_much_ends_it(kind: str, said: str) -> None:
    clock, faults = VirtualClock(), Faults([Fault(kind, 0.0)])
    actuator, sensor = FakeActuator(clock, faults), FakeSensor(clock, faults, rest())
    check = SignCheck(actuator, sensor, clock, np.zeros((9, 3)), LIMITS, 200.0, 0.005, 0.01, StopRequest())
    with pytest.raises(SafetyError, match=said):
        check.run()
    assert not actuator.torque and not actuator.commands
