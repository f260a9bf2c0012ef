"""Calibrates an arm, real or simulated, as it hangs at rest: settings to one versioned file."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import torch

from apcc_torch.composition.build_devices import Devices
from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.composition.calibrated import body_names, calibrated, device_settings
from apcc_torch.composition.realtime import RealtimeConfig
from apcc_torch.errors import HardwareError
from apcc_torch.experiments.folder import versions
from apcc_torch.files import write_json
from apcc_torch.hardware.calibration_file import ArmCalibration, rest_calibration
from apcc_torch.hardware.calibration_measurement import SignCheck, hanging_poses
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.realtime import realtime
from apcc_torch.hardware.records import Outcome
from apcc_torch.hardware.states import State
from apcc_torch.hardware.stop_request import StopRequest
from apcc_torch.hardware.stops import Halt, Stop, StopReason

log = logging.getLogger(__name__)

KIND, CALIBRATION = "calibration", "calibration.json"


def run(config: RealtimeConfig, folder: Path) -> tuple[Outcome, dict[str, float]]:
    """Measures, and writes calibration.json into `folder` and to `calibration.file` if that is given.

    Returns:
        How it ended, and what was found in numbers.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning, or the bodies are not where `robot.sensors` says.
    """
    devices = RealtimeBuilder(config).devices()
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
            found = measured(config, devices, request)
    except Halt as halt:
        return _outcome(halt.stop), {}
    except HardwareError as error:
        return _outcome(Stop(StopReason.NOT_ARMED if connected else StopReason.NOT_CONNECTED, str(error))), {}
    calibrated(config, found)
    paths = [folder / CALIBRATION, *([] if config.calibration.file is None else [Path(config.calibration.file)])]
    for path in paths:
        found.save(path)
    metrics = _metrics(found)
    write_json(folder / "versions.json", {**versions(), "seed": config.seed})
    write_json(folder / "metrics.json", metrics)
    message = f"calibration {found.id} is in {paths[-1]}: confirm it with calibration.file={paths[-1]}"
    return _outcome(Stop(StopReason.COMPLETED, message)), metrics


def measured(config: RealtimeConfig, devices: Devices, request: StopRequest) -> ArmCalibration:
    """The calibration of connected devices.

    Raises:
        SafetyError: The arm does not hang at rest, or a tendon does not do what it should.
        HardwareError: A device failed.
        Halt: It was asked to stop.
    """
    build, c = RealtimeBuilder(config), config.calibration
    actuator, sensor = devices.actuator, devices.sensor
    T = hanging_poses(sensor, devices.clock, c.frames, c.timeout)
    rest = rest_calibration(body_names(config), T, build.model.base_rotation(), c.scatter)
    tendons = actuator.calibrate()
    base = None if sensor.base is None else sensor.base.tolist()
    signs = None
    if c.check_signs:
        settings = build.guards(), build.loop()
        check = SignCheck(
            actuator, sensor, devices.clock, pull_directions(build), build.limits(), settings[0].effort_cap, c.pull,
            settings[1].period, request,
        )  # fmt: skip
        signs = check.run()
    made_at = datetime.now(UTC).isoformat(timespec="seconds")
    return ArmCalibration(made_at, device_settings(config), versions(), tendons, base, rest, signs)


def pull_directions(build: RealtimeBuilder) -> Array:
    """(n_a, 3) where the tip goes as each tendon is pulled in: to the tendon's own side of the hanging arm."""
    angles = build.model.routing().angles
    across = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), dim=-1)
    directions: Array = (across @ build.model.base_rotation().mT).double().numpy()
    return directions


def _outcome(stop: Stop) -> Outcome:
    state = State.FAULT if stop.reason.failed else State.DISARMED
    return Outcome(stop.reason, stop.message, None, state, 0, 0.0, 0)


def _metrics(found: ArmCalibration) -> dict[str, float]:
    metrics = {
        "exit_code": 0.0,
        "rest_frames": float(found.rest.rest_frames),
        "rest_scatter_mm": 1e3 * found.rest.rest_scatter_m,
        "rest_scatter_rad": found.rest.rest_scatter_rad,
    }
    for name, abscissa in zip(found.rest.names, found.rest.abscissae.tolist(), strict=True):
        metrics[f"abscissa_{name}_mm"] = 1e3 * abscissa
    for k, moved in enumerate(found.signs or ()):
        metrics[f"pull_{k + 1}_tip_mm"] = 1e3 * moved
    return metrics
