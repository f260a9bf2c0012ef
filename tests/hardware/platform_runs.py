"""Runs of the program on the emulated platform, for tests on machines that may be busy."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.experiments import calibrate as arm_calibration
from apcc_torch.hardware.stops import StopReason
from commands import environment
from composed import composed_realtime
from hardware.emulators.kinds import MOTORS
from hardware.emulators.rig import EmulatedPlatform
from started import Program

# A busy machine may starve the loop: these runs are about how they end.
PATIENT = (
    "loop.warm_up=5", "loop.fresh_timeout=60", "loop.fresh_frames=2", "loop.hold=0.2", "guards.overruns=100000",
    "guards.max_pause=100",
    "guards.sensing.max_age=100", "guards.sensing.stale=100", "guards.sensing.dropout=100",
    "guards.sensing.gate.max_speed=100", "guards.sensing.gate.max_angular_rate=1000", "guards.max_error=null",
    "hardware.sensor.timeout=30", "calibration.frames=5", "calibration.timeout=60", "view=false",
    "experiment.duration=100", "compile=off", "figures=false",
)  # fmt: skip
SLOW = "controller.K=0.02"  # a run that does not arrive before something happens to it
DEADLINE = 120.0  # s for what takes one


def calibrated(platform: EmulatedPlatform, folder: Path) -> Path:
    """The file of a calibration of the platform as it hangs, everything plugged in."""
    platform.renew()
    file = folder / "arm.json"
    config = _calibrating(*platform.overrides)
    named = replace(config, calibration=replace(config.calibration, file=str(file)))
    outcome, _ = arm_calibration.run(named, folder)
    assert outcome.reason is StopReason.COMPLETED, outcome.message
    return file


@cache
def _calibrating(*overrides: str) -> RealtimeSettings:
    return composed_realtime("experiment=calibration", *overrides, *PATIENT)


def arguments(platform: EmulatedPlatform, calibration: Path, *more: str) -> list[str]:
    """The program's command line to the set-point."""
    return ["experiment=setpoint", *platform.overrides, *PATIENT, f"calibration.file={calibration}", *more]


def program(platform: EmulatedPlatform, calibration: Path, *more: str) -> Program:
    """The program in a process of its own; its folder is `run` beside the calibration."""
    given = [*arguments(platform, calibration, *more), f"hydra.run.dir={calibration.parent / 'run'}"]
    return Program("apcc_torch.robot", given, calibration.parent, environment())


def until(condition: Callable[[], bool]) -> None:
    """Waits for the condition, and fails where it does not come about."""
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.05)


def moving(platform: EmulatedPlatform) -> bool:
    """Whether the motors have torque and were sent more than the goals they were armed with."""
    return bool(platform.servos.report()[MOTORS[0]]["told"] > 10)
