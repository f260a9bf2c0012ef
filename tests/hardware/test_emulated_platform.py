"""The whole runner on the emulated platform: the real SDK on a pseudo terminal, the real parser on loopback UDP.

Each emulator has its own process. What is asserted is how runs end and what they leave, not how fast they are: the
machine may be busy. `benchmarks/emulated.py` measures times, test_faults_end_to_end.py has the faults.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from apcc_torch.experiments import realtime_run as realtime
from apcc_torch.hardware.calibration_file import ArmCalibration
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.stops import StopReason
from composed import composed_realtime
from hardware.emulators.kinds import DYNAMIXEL, MOTORS
from hardware.emulators.rig import EmulatedPlatform
from hardware.platform_runs import DEADLINE, arguments, calibrated, program


@pytest.fixture(scope="module")
def platform(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedPlatform]:
    with EmulatedPlatform(tmp_path_factory.mktemp("platform")) as platform:
        yield platform


@pytest.fixture
def calibration(platform: EmulatedPlatform, tmp_path: Path) -> Path:
    """The file of a calibration."""
    return calibrated(platform, tmp_path)


def test_the_calibration_finds_the_emulated_arm(platform: EmulatedPlatform, calibration: Path) -> None:
    found = ArmCalibration.load(calibration)
    assert found.actuator["zero_ticks"] == list(DYNAMIXEL.zeros)
    assert np.abs(found.rest.abscissae.numpy() - [0.105, 0.36, 0.60]).max() < 1e-4
    assert np.abs(np.array(found.base) - platform.arm.base).max() < 1e-4


def test_the_program_arrives_and_its_log_replays(platform: EmulatedPlatform, calibration: Path) -> None:
    with program(platform, calibration, "loop.rate=100") as run:
        told = "".join(run.communicate(DEADLINE))
    assert run.returncode == 0 and "arrived: within 1 mm" in told, told
    folder = calibration.parent / "run"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["end_effector_error_start_mm"] > 100.0 and metrics["end_effector_error_end_mm"] < 1.0
    log = read_log(folder / "log.mcap")
    assert log.complete and "calibration.json" in log.attachments
    assert not [event for event in log.events if event["kind"] == "exchange_failed"]
    assert realtime.replay_log(log).difference <= 1e-9
    # The emulated arm, asked itself: its tip is where it was to go, in the arm's base frame.
    tip = np.linalg.inv(platform.arm.base) @ np.append(platform.arm(0.0)[-1, :3], 1.0)
    assert np.linalg.norm(tip[:3] - [0.0, 0.15, -0.5]) < 2e-3
    assert platform.goals_in_limits()
    assert all(motor["torque"] == 0 and not motor["tripped"] for motor in platform.servos.report().values())


def test_a_base_that_was_moved_since_the_calibration_is_not_armed(
    platform: EmulatedPlatform, calibration: Path, tmp_path: Path
) -> None:
    before = platform.arm.base
    moved = before.copy()
    moved[0, 3] += 0.02
    platform.arm.base = moved
    platform.cameras.set_poses(platform.arm)
    try:
        outcome, _ = realtime.run(composed_realtime(*arguments(platform, calibration)), tmp_path)
    finally:
        platform.arm.base = before
        platform.cameras.set_poses(platform.arm)
    assert outcome.reason is StopReason.NOT_ARMED and "the base has moved by 20.0 mm" in outcome.message
    assert not any(motor["torque"] for motor in platform.servos.report().values())


def test_motors_that_lost_power_since_the_calibration_are_not_armed(
    platform: EmulatedPlatform, calibration: Path, tmp_path: Path
) -> None:
    platform.servos.do("restart", MOTORS[6])
    outcome, _ = realtime.run(composed_realtime(*arguments(platform, calibration)), tmp_path)
    assert outcome.reason is StopReason.NOT_ARMED and "motor 7 (id 17) lost power" in outcome.message
