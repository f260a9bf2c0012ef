"""One bus with motors of four models, of which one tells no current and one has another table."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apcc_torch.errors import CommunicationError, HardwareError
from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from hardware.dynamixel.rig import POSITIONS, RADII, TENDONS, goals_in_limits, settings
from hardware.emulators.servo.emulator import ServoEmulator
from hardware.emulators.servo.models import TABLES, XL330_M288, XL430_W250, XM430_W210, XM430_W350

MODELS = (XM430_W210,) * 3 + (XM430_W350,) * 2 + (XL430_W250,) * 2 + (XL330_M288,) * 2
BLIND, SMALL = 5, 7  # places of the first XL430 and XL330


@pytest.fixture(scope="module")
def mixed_bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServoEmulator]:
    models = dict(zip(TENDONS, MODELS, strict=True))
    emulator = ServoEmulator(tmp_path_factory.mktemp("bus") / "servos", POSITIONS, models)
    yield emulator
    emulator.close()


@pytest.fixture
def mixed(mixed_bus: ServoEmulator) -> ServoEmulator:
    mixed_bus.do("fresh")
    return mixed_bus


def configured(port: Path, **changes: Any) -> DynamixelActuator:
    return DynamixelActuator(settings(port, model_number=MODELS, **changes))


def peek(emulator: ServoEmulator, motor: int, address: int, length: int) -> int:
    return int(emulator.do("peek", motor, address=address, length=length)["value"])


def test_each_motor_is_set_up_as_its_model_is(mixed: ServoEmulator, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING), configured(mixed.link) as actuator:
        actuator.calibrate()
        actuator.arm()
        for motor, model in zip(TENDONS, MODELS, strict=True):
            table = TABLES[model]
            assert peek(mixed, motor, 11, 1) == (5 if table.current else 4)
            assert peek(mixed, motor, 84, 2) == table.p_gain and peek(mixed, motor, 80, 2) == table.d_gain
            assert peek(mixed, motor, 63, 1) == table.shutdown
            assert peek(mixed, motor, 44, 4) == table.velocity
            assert mixed.report()[motor]["position"] == POSITIONS[motor]
        assert peek(mixed, TENDONS[0], 102, 2) == int(1.0 / 2.69e-3)
        assert peek(mixed, TENDONS[SMALL], 102, 2) == 1000
        # No control of the current: the voltage stalls it at 1 A of 1.4 A.
        assert peek(mixed, TENDONS[BLIND], 100, 2) == int(885 / 1.4)
        assert peek(mixed, TENDONS[0], 100, 2) == 885
    assert "motor 6 (id 16), motor 7 (id 17) tells no current: the guards of tensions do not see" in caplog.text


def test_readings_have_each_models_units(mixed: ServoEmulator) -> None:
    with configured(mixed.link) as actuator:
        actuator.calibrate()
        for motor in TENDONS:
            mixed.do("load", motor, current=100)
        effort = actuator.read().effort
        assert abs(effort[0]) == pytest.approx(0.269 * 3.0 / 2.3 / RADII[0])
        assert abs(effort[3]) == pytest.approx(0.269 * 4.1 / 2.3 / RADII[3])
        assert (effort[[BLIND, BLIND + 1]] == 0).all()
        assert abs(effort[SMALL]) == pytest.approx(0.1 * 0.52 / 1.47 / RADII[SMALL])


def test_tendons_move_and_a_calibration_outlives_the_program(mixed: ServoEmulator) -> None:
    with configured(mixed.link) as actuator:
        zero = actuator.calibrate()
        actuator.arm()
        y = np.linspace(-0.001, -0.009, 9)
        sent = actuator.send(y)
        for _ in range(100):  # a second at 100 Hz, and no exchange fails
            actuator.read()
            actuator.send(y)
            time.sleep(0.01)
        assert np.abs(actuator.read().y - sent).max() < 2e-4
    with configured(mixed.link) as later:
        later.restore(zero)
    mixed.do("restart", TENDONS[SMALL])
    with configured(mixed.link) as later, pytest.raises(HardwareError, match=r"^motor 8 \(id 18\) lost power since"):
        later.restore(zero)
    goals_in_limits(mixed)


@pytest.mark.parametrize("k", [0, BLIND, SMALL])
def test_a_motor_that_is_not_heard_is_named(mixed: ServoEmulator, k: int) -> None:
    with configured(mixed.link) as actuator:
        actuator.calibrate()
        mixed.do("corrupt", TENDONS[k], count=1)
        with pytest.raises(CommunicationError, match=rf"^motor {k + 1} \(id {TENDONS[k]}\): corrupt reply$"):
            actuator.read()
        assert np.abs(actuator.read().y).max() == 0.0


def test_two_motors_that_were_swapped_are_refused(mixed: ServoEmulator) -> None:
    swapped = (XL430_W250, *MODELS[1:])
    actuator = DynamixelActuator(settings(mixed.link, model_number=swapped))
    with pytest.raises(HardwareError, match=r"^motor 1 \(id 11\) is model 1030, not 1060$"):
        actuator.connect()


def test_an_old_330_is_refused(mixed: ServoEmulator) -> None:
    """Its indirect data lay elsewhere before firmware 52."""
    mixed.do("poke", TENDONS[SMALL], address=6, length=1, value=51)
    with pytest.raises(HardwareError, match=r"^motor 8 \(id 18\) has firmware 51, older than 52$"):
        configured(mixed.link).connect()
