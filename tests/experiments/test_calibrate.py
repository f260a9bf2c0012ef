"""The calibration of an arm: measured on the simulated one, kept in a file, confirmed by later runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.composition.calibrated import calibrated, load_calibration
from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.errors import ConfigError, DataError, SafetyError
from apcc_torch.experiments import calibrate as arm_calibration
from apcc_torch.experiments import realtime_run as realtime
from apcc_torch.hardware.calibration_confirmation import ConfirmationSettings, check_base
from apcc_torch.hardware.calibration_file import ArmCalibration
from apcc_torch.hardware.interfaces import PoseSensor
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.stops import StopReason
from composed import composed_realtime

QUICK = (
    "hardware=lockstep", "figures=false", "hardware.world.step=0.01", "plant.settle=0.5", "loop.hold=0.0",
    "calibration.frames=10", "loop.warm_up=3", "loop.fresh_frames=1", "experiment.duration=0.1", "view=false",
    "compile=off",
)  # fmt: skip


def settings(experiment: str, *overrides: str) -> RealtimeSettings:
    return composed_realtime(f"experiment={experiment}", *QUICK, *overrides)


def go(folder: Path, *overrides: str) -> tuple[StopReason, str]:
    folder.mkdir(exist_ok=True)
    outcome, _ = realtime.run(settings("setpoint", *overrides), folder)
    return outcome.reason, outcome.message


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibration")
    outcome, metrics = arm_calibration.run(settings("calibration", f"calibration.file={folder / 'arm.json'}"), folder)
    assert outcome.reason is StopReason.COMPLETED and outcome.exit_code == 0 and "arm.json" in outcome.message
    assert (folder / "calibration.json").read_bytes() == (folder / "arm.json").read_bytes()
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    return folder / "arm.json"


def test_it_finds_the_sensors_where_they_are(file: Path) -> None:
    found = ArmCalibration.load(file)
    assert np.abs(found.rest.abscissae.numpy() - [0.105, 0.36, 0.60]).max() < 3e-3
    again = ArmCalibration.load(file)
    assert again.id == found.id == json.loads(file.read_text())["id"]


def test_a_run_confirms_it_uses_it_and_keeps_it_with_its_log(file: Path, tmp_path: Path) -> None:
    reason, message = go(tmp_path, f"calibration.file={file}", f"calibration.id={ArmCalibration.load(file).id}")
    assert reason is StopReason.DURATION, message
    log = read_log(tmp_path / "log.mcap")
    assert log.attachments["calibration.json"] == file.read_text()
    measured = ArmCalibration.load(file).rest.abscissae.tolist()
    assert str(measured[0]) in log.attachments["config.yaml"]
    assert realtime.replay_log(log).difference == 0.0


def test_the_model_takes_what_was_measured_where_it_fits(file: Path) -> None:
    found = ArmCalibration.load(file)
    arm = calibrated(settings("setpoint"), found).arm
    assert list(arm.sensors) == list(arm.racks) == found.rest.abscissae.tolist()
    assert np.allclose(np.cumsum(arm.rest_lengths()), arm.sensors)
    unmeasured = calibrated(settings("setpoint", "calibration.lengths=false"), found).arm
    assert np.allclose(unmeasured.sensor_places(), [0.105, 0.36, 0.60])
    with pytest.raises(ConfigError, match=r"arm.sensors\[1\] is 0.4 m, and the calibration has 0.36"):
        calibrated(settings("setpoint", "arm.sensors=[0.105,0.4,0.6]"), found)


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("calibration.id=0123456789ab", "calibration.id is 0123456789ab"),
        ("arm.base=standing", "arm.base is standing, and was hanging"),
        ("calibration.file=nowhere.json", "nowhere.json cannot be read"),
        ("hardware=dynamixel_optitrack", r"hardware\.actuator\.ids is .*, and was None"),
    ],
)
def test_one_that_does_not_fit_is_refused_in_one_sentence(file: Path, override: str, sentence: str) -> None:
    overrides = [override] if "file" in override else [f"calibration.file={file}", override]
    with pytest.raises((ConfigError, DataError), match=sentence):
        load_calibration(composed_realtime("experiment=setpoint", *overrides))


def test_the_real_arm_needs_one() -> None:
    with pytest.raises(ConfigError, match=r"calibration\.file must name"):
        load_calibration(composed_realtime("experiment=setpoint", "hardware=dynamixel_optitrack"))


def test_a_file_that_was_changed_is_refused(file: Path, tmp_path: Path) -> None:
    content = json.loads(file.read_text())
    changed = tmp_path / "changed.json"
    for name, value, sentence in (
        ("made_at", "yesterday", "was changed"),
        ("version", 2, "has version 2"),
        ("kind", "x", "is not the calibration of an arm"),
    ):
        changed.write_text(json.dumps(content | {name: value}))
        with pytest.raises(DataError, match=sentence):
            ArmCalibration.load(changed)


def test_motors_that_are_others_and_bodies_that_hang_elsewhere_are_not_armed(file: Path, tmp_path: Path) -> None:
    found = ArmCalibration.load(file)
    replace(found, actuator={"zero_ticks": [1] * 9}).save(tmp_path / "motors.json")
    reason, message = go(tmp_path / "a", f"calibration.file={tmp_path / 'motors.json'}")
    assert reason is StopReason.NOT_ARMED and "does not fit: the calibration has the motors" in message
    moved = replace(found.rest, abscissae=found.rest.abscissae + 0.01)
    replace(found, rest=moved).save(tmp_path / "moved.json")
    reason, message = go(
        tmp_path / "b", f"calibration.file={tmp_path / 'moved.json'}", "calibration.rest_tolerance=0.005"
    )
    assert reason is StopReason.NOT_ARMED and "beside its place" in message


def test_a_base_that_moved_is_noticed(file: Path) -> None:
    class Elsewhere(PoseSensor):
        base = np.eye(4)
        connect = disconnect = latest = wait = None  # type: ignore[assignment]

    sensor = Elsewhere()
    found = replace(ArmCalibration.load(file), base=np.eye(4).tolist())
    check_base(found, sensor, ConfirmationSettings())
    sensor.base = np.eye(4)
    sensor.base[0, 3] = 0.006
    with pytest.raises(SafetyError, match=r"moved by 6\.0 mm"):
        check_base(found, sensor, ConfirmationSettings())


def test_a_wrong_sign_is_found_by_pulling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    right = arm_calibration.pull_directions
    two = lambda build: right(build)[:2]  # noqa: E731 - two tendons say it as well as nine
    monkeypatch.setattr(arm_calibration, "pull_directions", lambda build: two(build) * [[1.0], [-1.0]])
    outcome, metrics = arm_calibration.run(settings("calibration", "calibration.check_signs=true"), tmp_path)
    assert outcome.reason is StopReason.NOT_ARMED and not metrics
    assert outcome.message.startswith("tendon 2: pulled in by 5 mm, the tip moved by -")
    assert not (tmp_path / "calibration.json").exists()


def test_pulls_go_to_the_tendons_side() -> None:
    directions = arm_calibration.pull_directions(RealtimeBuilder(settings("calibration")))
    assert np.allclose(directions[0], [1.0, 0.0, 0.0])
    # The hanging base looks down: an angle of 120 degrees about its z axis is one of -120 degrees seen from above.
    assert np.allclose(directions[1], [-0.5, -np.sqrt(0.75), 0.0])
