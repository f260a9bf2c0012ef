"""The real devices from their settings: names, ranges, refusals, and no library before it is needed."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from apcc_torch.composition.build_devices import dynamixel_settings, optitrack_settings, real_devices
from apcc_torch.composition.hardware import CalibrationConfig, DynamixelConfig, OptiTrackConfig
from apcc_torch.conf_path import conf_path
from apcc_torch.errors import ConfigError
from apcc_torch.hardware import drivers
from apcc_torch.hardware.clock import MonotonicClock
from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from apcc_torch.hardware.dynamixel.settings import DynamixelSettings
from apcc_torch.hardware.optitrack.sensor import OptiTrackSensor
from apcc_torch.hardware.optitrack.settings import OptiTrackSettings
from composed import composed_realtime

REAL = ("experiment=setpoint", "hardware=dynamixel_optitrack")


def test_the_platform_is_the_papers() -> None:
    config = composed_realtime(*REAL)
    devices = real_devices(config)
    assert isinstance(devices.actuator, DynamixelActuator) and isinstance(devices.sensor, OptiTrackSensor)
    assert isinstance(devices.clock, MonotonicClock)
    motors, mocap = devices.actuator.settings, devices.sensor.settings
    assert len(motors.ids) == 9 and motors.gripper is None and motors.model_number == 1030
    assert list(motors.lower) == [-0.035] * 3 + [-0.075] * 6 and list(motors.upper) == [0.0] * 9
    assert len(mocap.bodies) == 3 and mocap.base_offset == (0.0, 0.0, 0.0205) and mocap.up == "z"
    # The guards that go with it are the platform's, not the simulated arm's.
    assert config.guards.limits.lower == list(motors.lower)


@pytest.mark.parametrize(
    ("config", "settings"), [(DynamixelConfig, DynamixelSettings), (OptiTrackConfig, OptiTrackSettings)]
)
def test_every_setting_of_a_driver_can_be_set(config: type, settings: type) -> None:
    assert {f.name for f in fields(config)} == {f.name for f in fields(settings)}


def test_every_key_is_in_the_files_that_explain_it() -> None:
    content = Path(conf_path(), "hardware", "dynamixel_optitrack.yaml").read_text()
    root = Path(conf_path(), "realtime.yaml").read_text()
    assert all(f"  {f.name}:" in content for kind in (DynamixelConfig, OptiTrackConfig) for f in fields(kind))
    assert all(f"  {f.name}:" in root for f in fields(CalibrationConfig))


def test_a_gripper_is_a_tenth_motor() -> None:
    config = composed_realtime(*REAL, "hardware.dynamixel.gripper.id=10").hardware.dynamixel
    assert config is not None
    found = dynamixel_settings(config).gripper
    assert found is not None and found.id == 10 and found.current_limit == 0.3
    config.gripper.id = 9
    with pytest.raises(ConfigError, match=r"hardware.dynamixel: ids and gripper.id must all differ"):
        dynamixel_settings(config)


def test_a_wrong_value_is_named_with_its_group() -> None:
    config = composed_realtime(*REAL, "hardware.optitrack.up=x").hardware.optitrack
    assert config is not None
    with pytest.raises(ConfigError, match=r"hardware.optitrack: up must be 'y' or 'z'"):
        optitrack_settings(config)
    with pytest.raises(ConfigError, match=r"hardware.dynamixel and hardware.optitrack must be given"):
        real_devices(composed_realtime("experiment=setpoint"))


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}", name="dynamixel_sdk.port_handler")

    config = composed_realtime(*REAL)
    monkeypatch.setattr(drivers.importlib, "import_module", missing)
    with pytest.raises(ConfigError, match=r"needs dynamixel_sdk: pip install 'apcc-torch\[hardware\]'"):
        real_devices(config)


def test_a_simulated_arm_loads_no_driver() -> None:
    program = (
        "import sys, apcc_torch.robot; "
        "print([m for m in sys.modules if m.partition('.')[0] in ('dynamixel_sdk', 'natnet', 'serial')])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
