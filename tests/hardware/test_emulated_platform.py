"""The whole runner on the emulated platform: the real SDK on a pseudo terminal, the real parser on loopback UDP.

Each emulator has its own process. What is asserted is how runs end and what they leave, not how fast they are: the
machine may be busy. `benchmarks/emulated.py` measures times.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import apcc_torch
from apcc_torch.experiments import arm_calibration, realtime
from apcc_torch.hardware.arm_calibration import ArmCalibration
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.hardware.records import Outcome
from apcc_torch.hardware.states import State
from apcc_torch.hardware.stops import Ending, StopReason
from composed import composed_realtime
from hardware.emulators.rig import MOTORS, ZEROS, EmulatedPlatform

ROOT = Path(apcc_torch.__file__).resolve().parents[1]
# A busy machine may starve the loop: these runs are about how they end.
PATIENT = (
    "loop.warm_up=5", "loop.fresh_timeout=60", "loop.fresh_frames=2", "loop.hold=0.2", "guards.overruns=100000",
    "guards.sensing.max_age=100", "guards.sensing.stale=100", "guards.sensing.dropout=100",
    "guards.sensing.max_speed=100", "guards.sensing.max_angular_rate=1000", "guards.max_error=null",
    "calibration.frames=10", "calibration.timeout=60", "view=false", "experiment.duration=100",
)  # fmt: skip
SLOW = "controller.K=0.02"  # a run that does not arrive before something happens to it
DEADLINE = 120.0  # s for what takes one


@pytest.fixture(scope="module")
def platform(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedPlatform]:
    with EmulatedPlatform(tmp_path_factory.mktemp("platform")) as platform:
        yield platform


@pytest.fixture
def calibration(platform: EmulatedPlatform, tmp_path: Path) -> Path:
    """The file of a calibration of the platform as it hangs, everything plugged in."""
    platform.renew()
    file = tmp_path / "arm.json"
    config = composed_realtime("experiment=calibration", *platform.overrides, *PATIENT, f"calibration.file={file}")
    outcome, _ = arm_calibration.run(config, tmp_path)
    assert outcome.reason is StopReason.COMPLETED, outcome.message
    return file


def arguments(platform: EmulatedPlatform, calibration: Path, *more: str) -> list[str]:
    return ["experiment=setpoint", *platform.overrides, *PATIENT, f"calibration.file={calibration}", *more]


def program(platform: EmulatedPlatform, calibration: Path, *more: str) -> subprocess.Popen[str]:
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "apcc_torch.robot", *arguments(platform, calibration, *more)]
    command.append(f"hydra.run.dir={calibration.parent / 'run'}")
    return subprocess.Popen(
        command, cwd=calibration.parent, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.05)


def moving(platform: EmulatedPlatform) -> bool:
    """Whether the motors have torque and were sent more than the goals they were armed with."""
    return len(platform.servos.report()[MOTORS[0]]["goals"]) > 10


def disturbed(platform: EmulatedPlatform, calibration: Path, disturb: Callable[[], object]) -> Outcome:
    """A run to which something happens once it is under way."""

    def wait_and_disturb() -> None:
        until(lambda: moving(platform))
        disturb()

    thread = threading.Thread(target=wait_and_disturb)
    thread.start()
    config = composed_realtime(*arguments(platform, calibration, SLOW))
    outcome, _ = realtime.run(config, "", calibration.parent)
    thread.join()
    log = read_log(calibration.parent / "log.mcap")
    assert log.complete and log.events[-1]["kind"] == "end" and log.events[-1]["reason"] == outcome.reason.value
    stops = [event for event in log.events if event["kind"] == "stop"]
    assert len(stops) == 1 and stops[0]["reason"] == outcome.reason.value
    return outcome


def test_the_calibration_finds_the_emulated_arm(platform: EmulatedPlatform, calibration: Path) -> None:
    found = ArmCalibration.load(calibration)
    assert found.actuator["zero_ticks"] == list(ZEROS)
    assert np.abs(found.rest.abscissae.numpy() - [0.105, 0.36, 0.60]).max() < 1e-4
    assert np.abs(np.array(found.base) - platform.arm.base).max() < 1e-4


def test_the_program_arrives_and_its_log_replays(platform: EmulatedPlatform, calibration: Path) -> None:
    with program(platform, calibration, "loop.rate=100") as run:
        told = run.communicate(timeout=DEADLINE)[0]
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


def test_an_unplugged_bus_ends_the_run(platform: EmulatedPlatform, calibration: Path) -> None:
    outcome = disturbed(platform, calibration, lambda: platform.servos.do("unplug"))
    assert outcome.reason is StopReason.COMMUNICATION and outcome.exit_code == 30
    assert outcome.ending is Ending.TORQUE_OFF and outcome.state is State.FAULT


def test_a_mute_motor_ends_the_run_and_the_others_let_go(platform: EmulatedPlatform, calibration: Path) -> None:
    outcome = disturbed(platform, calibration, lambda: platform.servos.do("mute", MOTORS[3]))
    assert outcome.reason is StopReason.COMMUNICATION and "motor 4 (id 14)" in outcome.message
    assert outcome.ending is Ending.TORQUE_OFF and outcome.state is State.FAULT
    report = platform.servos.report()
    assert [report[motor]["torque"] for motor in MOTORS] == [0, 0, 0, 1, 0, 0, 0, 0, 0]
    assert platform.goals_in_limits()


def test_cameras_that_stop_leave_the_arm_held_and_then_let_go(platform: EmulatedPlatform, calibration: Path) -> None:
    outcome = disturbed(platform, calibration, lambda: platform.cameras.fault(stop=True))
    assert outcome.reason is StopReason.SENSOR_LOST and outcome.exit_code == 20
    assert outcome.ending is Ending.HOLD and outcome.state is State.DISARMED
    assert all(motor["torque"] == 0 for motor in platform.servos.report().values())


def test_a_base_that_was_moved_since_the_calibration_is_not_armed(
    platform: EmulatedPlatform, calibration: Path, tmp_path: Path
) -> None:
    before = platform.arm.base
    moved = before.copy()
    moved[0, 3] += 0.02
    platform.arm.base = moved
    platform.cameras.set_poses(platform.arm)
    try:
        outcome, _ = realtime.run(composed_realtime(*arguments(platform, calibration)), "", tmp_path)
    finally:
        platform.arm.base = before
        platform.cameras.set_poses(platform.arm)
    assert outcome.reason is StopReason.NOT_ARMED and "the base has moved by 20.0 mm" in outcome.message
    assert not any(motor["torque"] for motor in platform.servos.report().values())


def test_motors_that_lost_power_since_the_calibration_are_not_armed(
    platform: EmulatedPlatform, calibration: Path, tmp_path: Path
) -> None:
    platform.servos.do("restart", MOTORS[6])
    outcome, _ = realtime.run(composed_realtime(*arguments(platform, calibration)), "", tmp_path)
    assert outcome.reason is StopReason.NOT_ARMED and "motor 7 (id 17) lost power" in outcome.message


def test_a_killed_program_is_stopped_by_the_motors_themselves(platform: EmulatedPlatform, calibration: Path) -> None:
    with program(platform, calibration, SLOW, "hardware.dynamixel.bus_watchdog=0.5") as run:
        until(lambda: moving(platform))
        run.kill()
        run.wait(timeout=DEADLINE)
    until(lambda: all(motor["tripped"] for motor in platform.servos.report().values()))
    first = platform.servos.report()
    time.sleep(0.3)
    second = platform.servos.report()
    assert [first[m]["position"] for m in MOTORS] == [second[m]["position"] for m in MOTORS]
    assert all(motor["torque"] == 1 for motor in second.values())  # held, not dropped
    assert platform.goals_in_limits()
    log = read_log(calibration.parent / "run" / "log.mcap")
    assert not log.complete
