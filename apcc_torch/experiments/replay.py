"""Replay of a recording: settings to a folder with q_bar(t), residuals, what was gated and why, and a figure."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.estimation.sensor_gate import SensorGate
from apcc_torch.experiments.folder import RunFolder, progress_bar, warn
from apcc_torch.model.coordinates import Coordinates
from apcc_torch.reading import keyed
from apcc_torch.recordings.data_set import located
from apcc_torch.recordings.held_out import held_out_error
from apcc_torch.recordings.recorded_arm import TRUNK_BASE, TRUNK_DIRECTION
from apcc_torch.recordings.recording_file import detect_layout
from apcc_torch.recordings.replay import replay
from apcc_torch.recordings.replay_log import replay_metrics, sensor_errors
from apcc_torch.recordings.rest_pose import calibrate, still_frame_count
from apcc_torch.recordings.session_file import load_rest, load_session
from apcc_torch.report.replay import ReplayCurves, replay_figure
from apcc_torch.report.style import save_figures
from apcc_torch.simulation.divergence import sentence


def run(config: SimulateSettings, folder: Path) -> dict[str, float]:
    """Replays `data` and writes the run's folder; returns the metrics.

    The calibration of the rest pose replaces the robot's sensor abscissae and rest lengths, one section ending at each
    sensor. With controller.adaptive=true the whole controller looks on and adapts, driven by the recorded target.

    Raises:
        ConfigError: No data is named, the rest cannot be told, adaptation is asked without a recorded target, or a
            setting has no meaning.
        DataError: The recording cannot be read.
    """
    started = time.perf_counter()
    r = config.replay
    data = config.data
    session = data.sessions[data.in_motion().learned]
    folder_of_data = located(data, config.data_root)
    recording = load_session(folder_of_data, session, config.recording)
    rest = load_rest(folder_of_data, data, config.recording)
    direction, base_position = r.direction, r.base_position
    if detect_layout(folder_of_data / session.file) == "trunk":
        # These recordings hold neither the way gravity points nor the base; what is known of them stands in.
        direction = TRUNK_DIRECTION if direction is None else direction
        base_position = TRUNK_BASE if base_position is None and r.first_abscissa is None else base_position
    if rest is None and r.rest is None and recording.inputs is None:
        with keyed("replay"):
            still_frame_count(recording)
    calibration = calibrate(
        recording if rest is None else rest,
        rest=r.rest if rest is None else len(rest),
        direction=direction,
        forward=r.forward,
        base_position=base_position,
        first_abscissa=r.first_abscissa,
    )
    lengths = [float(v) for v in calibration.rest_lengths]
    abscissae = [float(v) for v in calibration.abscissae]
    poses = {"sensed": None, "curvature_sensors": None}  # a recording holds no other kind
    arm = config.arm.changed(lengths=lengths, sensors=abscissae, racks=abscissae, **poses)
    build = Builder(config.changed(arm=arm))
    controller = build.controller()
    gate = SensorGate(calibration.abscissae, r.gate)
    frames = slice(r.frames)
    with torch.inference_mode():
        log = replay(
            recording,
            calibration,
            controller if config.controller.adaptive else controller.feedback,
            gate,
            pi_hat=build.first_estimate(),
            frames=frames,
            parallel=not config.controller.adaptive,
            progress=progress_bar("replay", config.progress),
        )
        held_out = held_out_error(
            recording,
            calibration,
            controller.feedback,
            gate,
            frames=frames,
            progress=progress_bar("held out", config.progress),
        )
        metrics = replay_metrics(log, recording.names, controller.feedback, held_out)
        linear, length = sensor_errors(log, controller.feedback).linear, calibration.rest_lengths.sum()
        causes = build.divergence().of_model(controller, length, log.time, log.q_bar, log.pi_hat, linear)
        metrics["diverged_rows"] = float(causes[-1].count_nonzero())
    said = sentence(log.time, causes)
    warn(said)
    calibration.save(folder / "calibration.json")
    metrics["wall_s"] = time.perf_counter() - started
    RunFolder(folder).write(metrics, log._asdict(), config.seed)
    if config.figures:
        coordinates = controller.backbone.coordinates
        _draw(log._asdict(), folder / "figures", data.name, coordinates, recording.names, said)
    return metrics


def redraw(config: SimulateSettings, arrays: dict[str, Tensor], into: Path, figured: bool, filmed: bool) -> None:
    """See `kinds.Kind`; there is no true arm to film."""
    _draw(arrays, into, config.data.name, Builder(config).backbone().coordinates)


def _draw(
    arrays: Mapping[str, Tensor],
    into: Path,
    title: str,
    coordinates: Coordinates,
    names: Sequence[str] | None = None,
    warning: str | None = None,
) -> None:
    fields = ("time", "q_bar", "angular_error", "linear_error", "position_reason", "orientation_reason")
    curves = ReplayCurves(*(arrays[name] for name in fields))
    save_figures({"replay.png": lambda: replay_figure(curves, names, title, coordinates)}, into, warning=warning)
