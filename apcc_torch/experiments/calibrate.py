"""Calibrates an arm, real or simulated, as it hangs at rest: settings to one versioned file."""

from __future__ import annotations

from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import torch

from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.composition.calibrated import calibrated, lasting_settings
from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.errors import HardwareError, SafetyError
from apcc_torch.experiments.folder import versions
from apcc_torch.files import write_json
from apcc_torch.hardware.calibration_file import ArmCalibration
from apcc_torch.hardware.calibration_measurement import SignCheck, hanging_poses, rest_calibration
from apcc_torch.hardware.devices import Devices
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.realtime import realtime
from apcc_torch.hardware.records import Outcome
from apcc_torch.hardware.states import State
from apcc_torch.hardware.stop_request import StopRequest
from apcc_torch.hardware.stops import Halt, Stop, StopReason
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)

KIND, CALIBRATION = "calibration", "calibration.json"


def run(settings: RealtimeSettings, folder: Path) -> tuple[Outcome, dict[str, float]]:
    """Measures, and writes calibration.json into `folder` and to `calibration.file` if that is given.

    Returns:
        How it ended, and what was measured in numbers.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning, or the bodies are not where `arm.sensors` says.
    """
    devices = RealtimeBuilder(settings).devices()
    request = StopRequest()
    connected = False
    try:
        with request.on_signals(), ExitStack() as stack, torch.inference_mode():
            stack.enter_context(realtime())
            # Registered before it is opened: a connection that fails half-way is taken back as well.
            stack.callback(devices.actuator.disconnect)
            devices.actuator.connect()
            stack.callback(devices.sensor.disconnect)
            devices.sensor.connect()
            connected = True
            calibration = measured(settings, devices, request)
    except Halt as halt:
        return _outcome(halt.stop), {}
    except HardwareError as error:
        return _outcome(Stop(StopReason.NOT_ARMED if connected else StopReason.NOT_CONNECTED, str(error))), {}
    calibrated(settings, calibration)
    paths = [folder / CALIBRATION, *([] if settings.calibration.file is None else [Path(settings.calibration.file)])]
    for path in paths:
        calibration.save(path)
    metrics = _metrics(calibration)
    write_json(folder / "versions.json", {**versions(), "seed": settings.seed})
    write_json(folder / "metrics.json", metrics)
    message = f"calibration {calibration.id} is in {paths[-1]}: confirm it with calibration.file={paths[-1]}"
    return _outcome(Stop(StopReason.COMPLETED, message)), metrics


def measured(settings: RealtimeSettings, devices: Devices, request: StopRequest) -> ArmCalibration:
    """The calibration of connected devices.

    Raises:
        SafetyError: The arm does not hang at rest, or a tendon does not do what it should.
        HardwareError: A device failed.
        Halt: It was asked to stop.
    """
    build, c = RealtimeBuilder(settings), settings.calibration
    actuator, sensor, clock = devices.actuator, devices.sensor, devices.world.clock
    T = hanging_poses(sensor, clock, c)
    rest = rest_calibration(sensor.names, T, build.model.base_rotation(), c.scatter)
    tendons = actuator.calibrate()
    base = None if sensor.base is None else sensor.base.tolist()
    signs = None
    if c.check_signs:
        if actuator.sets_pressure:
            raise SafetyError("calibration.check_signs pulls tendons, and this arm has chambers: leave it out")
        check = SignCheck(
            actuator, sensor, clock, pull_directions(build), build.limits(), settings.guards.effort_cap, c.pull,
            settings.loop.period, request,
        )  # fmt: skip
        signs = check.run()
    made_at = datetime.now(UTC).isoformat(timespec="seconds")
    return ArmCalibration(made_at, lasting_settings(settings), versions(), tendons, base, rest, signs)


def pull_directions(build: RealtimeBuilder) -> Array:
    """(n_a, 3) where the tip goes as each tendon is pulled in: to the tendon's own side of the hanging arm."""
    angles = build.model.routing().angles
    across = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), dim=-1)
    directions: Array = (across @ build.model.base_rotation().mT).double().numpy()
    return directions


def _outcome(stop: Stop) -> Outcome:
    state = State.FAULT if stop.reason.failed else State.DISARMED
    return Outcome(stop.reason, stop.message, None, state, 0, 0.0, 0)


def _metrics(calibration: ArmCalibration) -> dict[str, float]:
    metrics = {
        "exit_code": 0.0,
        "rest_frames": float(calibration.rest.rest_frames),
        "rest_scatter_mm": 1e3 * calibration.rest.rest_scatter_m,
        "rest_scatter_rad": calibration.rest.rest_scatter_rad,
    }
    for name, abscissa in zip(calibration.rest.names, calibration.rest.abscissae.tolist(), strict=True):
        metrics[f"abscissa_{name}_mm"] = 1e3 * abscissa
    for k, moved in enumerate(calibration.signs or ()):
        metrics[f"pull_{k + 1}_tip_mm"] = 1e3 * moved
    return metrics
