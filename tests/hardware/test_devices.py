"""Devices by the names of their classes: the platform's, the simulated arm's, and those of somebody else's own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import apcc_torch
from apcc_torch.classes import ALLOWED
from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.composition.schema import from_text, schema, text
from apcc_torch.errors import ConfigError
from apcc_torch.hardware.clock import MonotonicClock
from apcc_torch.hardware.devices import HardwareSettings, devices
from apcc_torch.hardware.dynamixel.actuator import DynamixelActuator
from apcc_torch.hardware.feetech.actuator import FeetechActuator
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.optitrack.sensor import OptiTrackSensor
from apcc_torch.hardware.simulated.actuator import SimulatedActuator
from apcc_torch.hardware.simulated.world import LockstepWorld
from apcc_torch.reading import defaults, plain, read
from apcc_torch.robot_log import main as robot_log
from composed import composed_realtime

ROOT = Path(apcc_torch.__file__).resolve().parents[1]
REAL = ("experiment=setpoint", "hardware=dynamixel_optitrack")


def test_the_platform_is_the_papers() -> None:
    settings = composed_realtime(*REAL)
    actuator, sensor, world = RealtimeBuilder(settings).devices()
    assert isinstance(actuator, DynamixelActuator) and isinstance(sensor, OptiTrackSensor)
    assert isinstance(world.clock, MonotonicClock) and world.metrics() == {}
    motors, mocap = actuator.settings, sensor.settings
    assert len(motors.ids) == 9 and motors.gripper is None and motors.model_number == 1030
    assert motors.each("lower") == [-0.035] * 3 + [-0.075] * 6 and motors.each("upper") == [0.0] * 9
    assert sensor.names == ("disk_1", "disk_3", "disk_5")
    assert mocap.base_offset == (0.0, 0.0, 0.0205) and mocap.up == "z"
    # The guards that go with it are the platform's, not the simulated arm's.
    guards = settings.guards
    assert guards.limits.lower == tuple(motors.each("lower")) and guards.effort_cap == 100.0
    assert (guards.sensing.gate.max_speed, guards.sensing.gate.max_bend, guards.sensing.max_age) == (1.0, 3.0, 0.06)


def test_servos_of_another_make_are_a_preset_with_the_same_sensor() -> None:
    settings = composed_realtime("experiment=setpoint", "hardware=feetech_optitrack")
    actuator, sensor, _ = RealtimeBuilder(settings).devices()
    assert isinstance(actuator, FeetechActuator) and isinstance(sensor, OptiTrackSensor)
    paper = composed_realtime(*REAL).hardware
    assert actuator.settings.each("lower") == paper.actuator.each("lower")  # type: ignore[attr-defined]
    assert sensor.settings == paper.sensor


def test_the_defaults_are_what_the_command_line_builds() -> None:
    settings = composed_realtime("experiment=setpoint")
    for name in ("hardware", "guards", "loop", "calibration", "ramp", "series"):
        assert getattr(settings, name) == type(getattr(settings, name))(), name
    assert read(plain(settings), RealtimeSettings) == settings
    assert schema(RealtimeSettings).keys() == defaults(RealtimeSettings).keys()


def test_a_gripper_is_a_tenth_motor() -> None:
    gripper = composed_realtime(*REAL, "hardware.actuator.gripper.id=10").hardware.actuator.gripper  # type: ignore[attr-defined]
    assert gripper.id == 10 and gripper.current_limit == 0.3
    with pytest.raises(ConfigError, match=r"^hardware\.actuator\.ids must .*differ .*gripper\.id"):
        composed_realtime(*REAL, "hardware.actuator.gripper.id=9")


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ((*REAL, "hardware.sensor.up=x"), r"^hardware\.sensor\.up must be one of y, z, got 'x'"),
        ((*REAL, "hardware.sensor.upp=z"), r"^hardware\.sensor\.upp is no setting; did you mean up\?"),
        ((*REAL, "hardware.sensor.gripper=1"), r"^hardware\.sensor\.gripper is no setting"),
        (("hardware.actuator.kind=nowhere.Motors",), r"^hardware\.actuator\.kind must be a class, .*'nowhere'"),
        (
            ("hardware.actuator.kind=apcc_torch.hardware.optitrack.sensor.OptiTrackSensor",),
            r"^hardware\.actuator\.kind must be a TendonActuator, got",
        ),
        (
            ("hardware.actuator.kind=apcc_torch.hardware.interfaces.TendonActuator",),
            "is complete, and apcc_torch.hardware.interfaces.TendonActuator lacks arm, calibrate, connect",
        ),
        (("hardware.actuator.kind=apcc_torch.hardware.dynamixel.actuator.DynamixelActuator",), "port must be given"),
    ],
)
def test_what_has_no_meaning_is_named_by_its_key(overrides: tuple[str, ...], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        composed_realtime("experiment=setpoint", *overrides)


def test_a_simulated_device_needs_a_simulated_arm() -> None:
    settings = composed_realtime("experiment=setpoint", "hardware.world.kind=apcc_torch.hardware.world.RealWorld")
    with pytest.raises(ConfigError, match="a simulated device needs a simulated arm, and there is none in RealWorld"):
        RealtimeBuilder(settings).devices()


MISSING = """
import sys
sys.modules["dynamixel_sdk"] = sys.modules["scservo_sdk"] = sys.modules["natnet"] = None
sys.path.insert(0, {tests!r})
from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.errors import ConfigError
from apcc_torch.part import part_of
from composed import composed_realtime
for platform in ("feetech_optitrack", "dynamixel_optitrack"):
    settings = composed_realtime("experiment=setpoint", f"hardware={{platform}}")
    try:
        RealtimeBuilder(settings).devices()
    except ConfigError as error:
        print(error)
try:
    part_of(settings.hardware.sensor)(settings.hardware.sensor)
except ConfigError as error:
    print(error)
"""


def run(program: str, folder: Path) -> str:
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "-c", program], cwd=folder, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_missing_library_is_named_with_what_installs_it(tmp_path: Path) -> None:
    """The settings can be read without it, as those in the log of an arm are on another computer."""
    assert run(MISSING.format(tests=str(Path(__file__).resolve().parents[1])), tmp_path).splitlines() == [
        "FeetechActuator needs scservo_sdk: pip install 'apcc-torch[feetech]'",
        "DynamixelActuator needs dynamixel_sdk: pip install 'apcc-torch[hardware]'",
        "OptiTrackSensor needs natnet: pip install 'apcc-torch[hardware]'",
    ]


def test_a_simulated_arm_loads_no_driver(tmp_path: Path) -> None:
    libraries = "('dynamixel_sdk', 'scservo_sdk', 'natnet', 'serial')"
    loaded = f"[m for m in sys.modules if m.partition('.')[0] in {libraries}]"
    assert run(f"import sys, apcc_torch.robot; print({loaded})", tmp_path).strip() == "[]"


def test_actuator_and_sensor_share_a_world_and_are_chosen_apart() -> None:
    settings = composed_realtime("experiment=setpoint", "hardware=lockstep", "hardware.sensor.rate=100")
    actuator, sensor, world = RealtimeBuilder(settings).devices()
    assert isinstance(world, LockstepWorld) and isinstance(actuator, SimulatedActuator)
    assert world is actuator.world is sensor.world  # type: ignore[attr-defined]
    assert (world.arm.motor_speed, world.arm.frame_rate) == (0.3, 100.0)


# One file, and no edit anywhere else.
DRIVER = '''
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apcc_torch.hardware.interfaces import PoseSample, PoseSensor, TendonActuator, TendonReading
from apcc_torch.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class CountingMotorsSettings(Settings):
    tendons: int = setting(9, meaning="how many", least=1)
    stiffness: float = setting(unit="N/m", meaning="has to be given", above=0)


class CountingMotors(TendonActuator):
    """Motors that are at once where they are sent; one step of 1 mm is one tick."""

    settings_type = CountingMotorsSettings
    needs_calibration = False

    def __init__(self, settings, clock):
        self.settings, self.clock, self.n_tendons = settings, clock, settings.tendons
        self.y = np.zeros(self.n_tendons)

    @classmethod
    def in_world(cls, settings, world):
        return cls(settings, world.clock)

    def connect(self): ...
    def calibrate(self): return {}
    def restore(self, zero): ...
    def arm(self): ...
    def hold(self): ...
    def torque_off(self): ...
    def disconnect(self): ...

    def read(self):
        zero = np.zeros(self.n_tendons)
        ticks = np.rint(1e3 * self.y).astype(int).tolist()
        return TendonReading(self.clock.now(), self.y, zero, self.settings.stiffness * np.abs(self.y), {"ticks": ticks})

    def send(self, y):
        self.y = np.rint(1e3 * y) / 1e3
        return self.y
'''


def test_a_driver_in_one_file_of_somebody_elses_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my_motors.py").write_text(DRIVER)
    monkeypatch.syspath_prepend(tmp_path)
    kind = "hardware.actuator.kind=my_motors.CountingMotors"
    with pytest.raises(ConfigError, match=r"^hardware\.actuator\.stiffness must be given"):
        composed_realtime("experiment=setpoint", kind)
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "apcc_torch.robot", "experiment=setpoint", "hardware=lockstep", "view=false"]
    command += ["compile=off", "plant.settle=0.5", "hardware.world.step=0.01", "experiment.duration=0.5"]
    command += [kind, "hardware.actuator.stiffness=200", "hydra.run.dir=run"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    path = tmp_path / "run" / "log.mcap"
    log = read_log(path)
    tendons, raw = log.topic("/tendons"), log.topic("/tendons/raw")
    assert abs(tendons["sent"]).max() > 2e-3 and (abs(tendons["sent"] * 1e3 % 1.0) < 1e-9).all()
    assert (raw["ticks"][-1] == (1e3 * tendons["y"][-1]).round()).all()

    # The log names a class of elsewhere: it is built only where that is allowed by name.
    assert robot_log(["replay", str(path)]) == 2
    said = capsys.readouterr().err
    assert "hardware.actuator.kind names my_motors.CountingMotors, which is not of this package" in said
    try:
        assert robot_log(["replay", str(path), "--allow-class", "my_motors.CountingMotors"]) == 0
    finally:
        ALLOWED.discard("my_motors.CountingMotors")


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"hardware": {"sensor": {"kind": "never_imported.Cameras"}}}, "hardware.sensor.kind names never_imported.Cam"),
        ({"hardware": {"world": {"kind": "never_imported.World"}}}, "hardware.world.kind names never_imported.World"),
        ({"model": {"kind": "never_imported.Model"}}, "model.kind names never_imported.Model, which is not"),
        ({"guards": {"overruns": "${oc.env:HOME}"}}, "guards.overruns must be a whole number, got '${oc.env:HOME}'"),
        ({"guards": {"overrun": 3}}, "guards.overrun is no setting; did you mean overruns?"),
    ],
)
def test_a_log_builds_nothing_of_elsewhere_and_reads_no_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: dict[str, object], sentence: str
) -> None:
    """A file that came from elsewhere is plain values: nothing in it is resolved, imported or run."""
    (tmp_path / "never_imported.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    content = yaml.safe_load(text(composed_realtime("experiment=setpoint")))
    for group, values in changed.items():
        content[group] |= values
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        from_text(yaml.safe_dump(content), RealtimeSettings)


def test_a_logs_settings_come_back_whole() -> None:
    settings = composed_realtime("experiment=setpoint", "hardware=dynamixel_optitrack", "guards.endings.slack=hold")
    assert from_text(text(settings), RealtimeSettings) == settings
    unresolved = text(settings).replace("port: /dev", "port: ${oc.env:HOME}/dev")
    assert from_text(unresolved, RealtimeSettings).hardware.actuator.port.startswith("${oc.env:HOME}")  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match="the file of settings cannot be read: it names a type"):
        from_text("a: !!python/object/apply:os.system ['true']", RealtimeSettings)


def test_devices_take_any_world() -> None:
    """Without a simulated device nothing makes the simulated arm."""
    settings = composed_realtime(*REAL).hardware
    assert isinstance(settings, HardwareSettings)

    def never(step: float) -> None:
        raise AssertionError("no simulated arm is needed")

    assert devices(settings, never).world.metrics() == {}  # type: ignore[arg-type]
