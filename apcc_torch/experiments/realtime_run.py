"""One run on an arm, real or simulated: settings to a folder with its log, metrics and events."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from apcc_torch.composition.build_realtime import RealtimeBuilder
from apcc_torch.composition.calibrated import calibrated, load_calibration
from apcc_torch.composition.realtime import BROWSER, FOXGLOVE, RealtimeSettings
from apcc_torch.composition.schema import from_text, text
from apcc_torch.control.controller import APCCController
from apcc_torch.errors import DataError
from apcc_torch.experiments.folder import versions, warn
from apcc_torch.experiments.realtime_figures import draw
from apcc_torch.files import write_json
from apcc_torch.hardware.calibration_confirmation import calibration_checks
from apcc_torch.hardware.calibration_file import ArmCalibration
from apcc_torch.hardware.control import Decision
from apcc_torch.hardware.devices import Devices
from apcc_torch.hardware.log import RunLog
from apcc_torch.hardware.log_reader import RobotLog
from apcc_torch.hardware.log_replay import Replayed, replay
from apcc_torch.hardware.mounts import Mounts
from apcc_torch.hardware.realtime import freeze, realtime
from apcc_torch.hardware.records import Event, Observer, Outcome
from apcc_torch.hardware.runner import Runner
from apcc_torch.hardware.setup import Setup
from apcc_torch.hardware.stop_request import StopRequest
from apcc_torch.hardware.stops import StopReason
from apcc_torch.hardware.summary import Summary
from apcc_torch.hardware.view import TerminalView
from apcc_torch.messages.live_stream import STREAM
from apcc_torch.plain_text import plain_logger
from apcc_torch.report.style import attempt
from apcc_torch.simulation.divergence import sentence
from apcc_torch.simulation.kinematic import KinematicLog
from apcc_torch.simulation.metrics import backbone_error
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.live_process import Watched
from apcc_torch.viewing.live_view import PAGE, LiveView
from apcc_torch.viewing.outline import Outline

log = plain_logger(__name__)

VIEWS = {BROWSER: ("page", PAGE), FOXGLOVE: ("stream", STREAM)}
"""What `view` may be beside a terminal -> the settings of its address, and how it is shown."""
LOG, CONFIG, CALIBRATION = "log.mcap", "config.yaml", "calibration.json"


def run(settings: RealtimeSettings, folder: Path) -> tuple[Outcome, dict[str, float]]:
    """Runs the configured experiment once.

    Args:
        settings: Of the run; its log carries them.
        folder: For the log, events and metrics.

    Returns:
        How it ended, and its metrics.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
        DataError: The log cannot be opened.
        HardwareError: The priority or memory that was asked for is refused.
    """
    RealtimeBuilder(settings).way()  # what is refused is so before machine code is built, which takes its time
    calibration = load_calibration(settings)
    # The devices are what they are, whatever the model takes from the calibration.
    devices = RealtimeBuilder(settings).devices()
    attached = {}
    if calibration is not None:
        settings = calibrated(settings, calibration)
        attached[CALIBRATION] = calibration.text()
    attached[CONFIG] = text(settings)
    build = RealtimeBuilder(settings)
    summary = Summary(devices.world.true_coordinates)
    observers: list[Observer] = [summary]
    request = StopRequest()
    setup = _setup(build, devices, request, observers, calibration)
    log_file = None
    with ExitStack() as stack:
        stack.enter_context(request.on_signals())
        offset = time.time() - devices.world.clock.now()
        if settings.log:
            log_file = stack.enter_context(_log(build, offset, attached, folder))
            observers.append(log_file)
        if settings.view in VIEWS:
            address, showing = VIEWS[settings.view]
            view = LiveView(_watched(build), getattr(settings, address), showing, offset)
            observers.append(stack.enter_context(view))
        elif settings.view is True and sys.stdout.isatty():
            observers.append(stack.enter_context(TerminalView(sys.stdout)))
        stack.enter_context(realtime(settings.loop.priority, settings.loop.lock_memory))
        outcome = Runner(setup).run()
    failure = None if log_file is None else log_file.failure()
    metrics = summary.metrics(outcome) | devices.world.metrics()
    if summary.decisions:
        causes = _causes(build, setup.control.controller, summary)
        metrics["diverged_rows"] = float(outcome.reason is StopReason.DIVERGENCE or bool(causes[-1] > 0))
        warn(sentence(_stacked("time", summary.decisions), causes))
    try:
        _write(folder, settings.seed, summary.events, metrics)
    except OSError as error:
        failure = failure or f"{folder} cannot be written: {error}"
    if settings.figures and summary.decisions:
        with attempt("the run"):
            draw(build, setup.control.controller, summary, causes, folder / "figures")
    if failure is not None:
        log.error("%s", failure)
        if not outcome.reason.failed:
            outcome = replace(outcome, reason=StopReason.LOG_FAILED, message=failure)
    return outcome, metrics


def _setup(
    build: RealtimeBuilder,
    devices: Devices,
    request: StopRequest,
    observers: list[Observer],
    calibration: ArmCalibration | None,
) -> Setup:
    setup = Setup(
        devices.actuator,
        devices.sensor,
        build.sensing(None if calibration is None else Mounts.of(calibration.rest)),
        build.control(),
        build.limits(),
        build.guards(),
        build.settings.loop,
        devices.world.clock,
        build.settings.experiment.duration,
        request,
        observers,
        prepared=freeze,
    )
    if calibration is None:
        return setup
    return replace(setup, checks=calibration_checks(calibration, setup, build.settings.calibration))


def _watched(build: RealtimeBuilder) -> Watched:
    """What a page shows of the arm."""
    model, sensors = build.model, build.model.sensors_at().shape[-1]
    outline = Outline(model.backbone(), model.n_sections, model.routing())
    return Watched(build.settings.experiment.name, DrawnSize.of(model.arm), outline, sensors)


def _stacked(name: str, decisions: list[Decision]) -> Tensor:
    return torch.from_numpy(np.array([getattr(each, name) for each in decisions]))


def _causes(build: RealtimeBuilder, controller: APCCController, summary: Summary) -> Tensor:
    """(T, 1) `Cause`s by which the run has diverged until each decision, the model and, if simulated, the true arm."""
    settings, decisions = build.settings, summary.decisions
    names = ("time", "q_bar", "pi_hat", "linear_error", "e")
    time, q_bar, pi_hat, linear, e = (_stacked(name, decisions) for name in names)
    # Nothing drives the arm to a target where tendons go their own way, or have no torque.
    driven = settings.experiment.kind != "tendons" and not settings.dry_run
    length = build.model.rest_lengths().sum()
    of = build.model.divergence()
    causes = of.of_model(controller, length, time, q_bar, pi_hat, linear, e.norm(dim=-1) if driven else None)
    truths = [q for q in summary.truths if q is not None]
    if len(truths) < len(decisions):
        return causes
    plant = build.model.plant(build.payload())
    true, lengths = plant.backbone, plant.dynamics.lengths
    q_true = torch.from_numpy(np.array(truths)).to(lengths)
    seen = _seen(decisions, q_true, true.tip(q_true, lengths), driven)
    shape = backbone_error(true, seen.q_true, lengths, controller.backbone, seen.q_bar, seen.pi_hat)
    bounds = controller.bounds if controller.adaptive else None
    return causes | of.of_arm(seen, shape, lengths, true, controller.backbone, bounds)


def _seen(decisions: list[Decision], q_true: Tensor, x: Tensor, driven: bool) -> KinematicLog:
    """The decisions beside the true arm's coordinates (T, n) and tip (T, 3), as one row of a simulation."""
    names = ("q_bar", "qdot", "pi_hat", "angular_error", "linear_error")
    x_d, *model = (_stacked(name, decisions).to(q_true) for name in ("x_d", *names))
    rows = (each.unsqueeze(1) for each in (x_d if driven else x, x, q_true, *model, _stacked("status", decisions)))
    return KinematicLog(_stacked("time", decisions), *rows)


def _log(build: RealtimeBuilder, offset: float, attached: dict[str, str], folder: Path) -> RunLog:
    try:
        stream = (folder / LOG).open("wb")
    except OSError as error:
        raise DataError(f"the log {folder / LOG} cannot be opened: {error.strerror}") from error
    return RunLog(stream, build.layouts(), offset, {"versions": versions()}, attached)


def _write(folder: Path, seed: int, events: list[Event], metrics: dict[str, float]) -> None:
    """events.json, versions.json and, last, metrics.json: a folder with metrics is complete."""
    write_json(folder / "events.json", {"events": [event.plain() for event in events]})
    write_json(folder / "versions.json", {**versions(), "seed": seed})
    write_json(folder / "metrics.json", metrics)


def settings_of(record: RobotLog) -> RealtimeSettings:
    """The settings that a log carries.

    Raises:
        DataError: It carries none.
        ConfigError: They have no meaning, or name a class that is neither of this package nor allowed.
    """
    if CONFIG not in record.attachments:
        raise DataError("the log carries no settings to build its controller from")
    return from_text(record.attachments[CONFIG], RealtimeSettings)


def replay_log(record: RobotLog) -> Replayed:
    """A log once more through the controller that its own settings describe; eagerly where it cannot be compiled here.

    Raises:
        DataError: The log has no settings, or no control step.
        ConfigError: Its settings have no meaning.
    """
    settings = settings_of(record)
    if settings.compile == "aot":
        settings = settings.changed(compile="auto")
    return replay(record, RealtimeBuilder(settings).control())
