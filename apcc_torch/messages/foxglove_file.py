"""Finished runs as MCAP files that Foxglove opens: simulations, and logs of runs on an arm with all that they hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from apcc_torch.errors import DataError
from apcc_torch.files import draft_of
from apcc_torch.hardware.log_format import EVENT_TOPIC, HEADER
from apcc_torch.hardware.log_reader import RobotLog
from apcc_torch.hardware.stops import StopReason
from apcc_torch.messages.foxglove_stream import FoxgloveStream, Streamed
from apcc_torch.messages.run_layout import Numbers
from apcc_torch.messages.topic import FileSink, Topic
from apcc_torch.viewing.moment import Array
from apcc_torch.viewing.recorded import Recorded

SCENE_PERIOD = 0.05
"""Least time between two scenes, s: they are what is large in a file."""
FARTHEST = 1e6
"""Of what is drawn, m; what a damaged log says may be anywhere."""
PREFIX = "/log"
"""What stands before a log's own topics."""
FAILURES = frozenset(reason.value for reason in StopReason if reason.failed)


class _Due(NamedTuple):
    """A message to write: its stamp, ns since 1970, and what writes it."""

    stamp: int
    write: Callable[[], None]


def write_foxglove(
    run: Recorded | None, path: Path | str, log: RobotLog | None = None, row: int = 0, began: int = 0
) -> Path:
    """Writes a run as an MCAP file for Foxglove; see `FoxgloveStream` for its topics.

    Args:
        run: The run; None where the settings of a log's controller cannot be had, and its own topics are all there is.
        path: The file.
        log: That the run is of, on an arm: its own topics are taken over byte for byte, below `/log`, with every
            measurement and event, at the stamps that it has.
        row: Of a simulation, which of its rows.
        began: When its time was zero, ns since 1970; a log knows it.

    Raises:
        ConfigError: foxglove-sdk or mcap is not installed.
        DataError: The run has no such row, or its log nothing that dates it.
        WriteError: The file cannot be written.
    """
    if run is not None and not 0 <= row < len(run.rows):
        raise DataError(f"row must be 0 to {len(run.rows) - 1}, got {row}")
    with draft_of(Path(path)) as draft, draft.open("wb") as file, FileSink(file) as sink:
        due = []
        if run is not None:
            stream = FoxgloveStream(sink, Streamed.of(run.size, run.arm, run.model))
            due += _instants(stream, run, row, began if log is None else log.began, log is None)
            due += [] if log is None else _seen(stream, log)
        if log is not None:
            due += _logged(sink, log)
            for name, entries in log.metadata.items():
                sink.writer.add_metadata(name, entries)
            for name, text in log.attachments.items():
                sink.writer.add_attachment(0, 0, name, "text/plain", text.encode())
        for message in sorted(due, key=lambda each: each.stamp):
            message.write()
    return Path(path)


def numbers_at(run: Recorded, k: int, row: int) -> tuple[Array, Numbers]:
    """The pose of the tip (4, 4), m, and the numbers of an instant."""
    q, lengths = run.q[k, row], run.lengths if run.lengths.dim() == 1 else run.lengths[k, row]
    tip = run.arm.poses(q, lengths, lengths.sum(-1, keepdim=True))[0]
    n_a = 0 if run.arm.routing is None else run.arm.routing.n_tendons
    tension = np.full(n_a, math.nan) if run.tension is None else run.tension[k, row].numpy()
    target, pi_hat = run.x_d[k, row].numpy(), run.pi_hat[k, row].numpy()
    numbers = Numbers(float(run.time[k]), float(run.error[k, row]), target, tip[:3, 3], q.numpy(), pi_hat, tension)
    return tip, numbers


def _instants(stream: FoxgloveStream, run: Recorded, row: int, began: int, sensed: bool) -> list[_Due]:
    """The run's instants, with the sensors of a simulation; scenes are fewer."""

    def write(k: int, stamp: int, drawn: bool) -> None:
        with torch.inference_mode():
            stream.instant(*numbers_at(run, k, row), stamp)
        if not (drawn or sensed):
            return
        moment = run.moment(k, row)
        if sensed and moment.sensors is not None:
            stream.measured(moment.sensors, stamp)
        if drawn and np.abs(moment.sections).max() < FARTHEST:
            stream.scene(moment, stamp)

    due, shown = [], -math.inf
    for k, time in enumerate(run.time.tolist()):
        drawn = time >= shown + SCENE_PERIOD - 1e-9
        shown = time if drawn else shown
        stamp = _stamp(began, time)
        due.append(_Due(stamp, partial(write, k, stamp, drawn)))
    return due


def _stamp(began: int, time: float) -> int:
    return max(began + round(1e9 * time), 0)


def _logged(sink: FileSink, log: RobotLog) -> list[_Due]:
    """A log's own topics."""
    due = []
    for name, rows in log.topics.items():
        topic = Topic.numbers(log.layouts[name], PREFIX)
        for row, stamp in zip(rows, log.stamps[name].tolist(), strict=True):
            due.append(_Due(stamp, partial(sink.add, topic, HEADER + row.tobytes(), stamp, stamp)))
    return due


def _seen(stream: FoxgloveStream, log: RobotLog) -> list[_Due]:
    """A log's measurements and events."""
    due, began, frames = [], log.began, log.topic("/measurement")
    stamps = log.stamps["/measurement"].tolist()
    for T, time, stamp in zip(seen_poses(frames), frames["time"].tolist(), stamps, strict=True):
        taken = _stamp(began, time) if math.isfinite(time) else stamp
        due.append(_Due(stamp, partial(stream.measured, T, taken, stamp)))
    for event, stamp in zip(log.events, log.stamps.get(EVENT_TOPIC, np.empty(0)).tolist(), strict=True):
        told = f"{event['state']}: {event['message']}"
        due.append(_Due(stamp, partial(stream.remark, str(event["kind"]), told, event["reason"] in FAILURES, stamp)))
    return due


def seen_poses(frames: Array) -> Array:
    """(T, k, 4, 4) of a log's measurements, m, NaN where a body was not accepted whole."""
    seen = (frames["position_ok"] & frames["orientation_ok"]).astype(bool)
    poses: Array = np.where(seen[..., None, None], frames["poses"].reshape(len(frames), -1, 4, 4), np.nan)
    return poses
