"""A log as other tools like it: parquet tables, or a recording for the rerun viewer."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from apcc_torch.errors import ConfigError, DataError, in_a_line
from apcc_torch.files import draft_of
from apcc_torch.hardware.log_reader import RobotLog
from apcc_torch.lie.rotations import rotation_quaternion
from apcc_torch.plain_text import for_spreadsheet, for_terminal
from apcc_torch.recordings.recording import Recording, save_recording

SCALARS = ("time", "tick", "sequence", "lateness")
"""Fields that are one number."""
LONGEST_NAME = 100
"""Most letters of a topic in the name of its file."""


def columns(rows: NDArray[np.void]) -> dict[str, NDArray[np.generic]]:
    """A structured array as flat columns: `y` of nine tendons becomes y_1 to y_9."""
    flat: dict[str, NDArray[np.generic]] = {}
    for name in rows.dtype.names or ():
        values = rows[name]
        if values.ndim == 1:
            flat[name] = values
        else:
            flat |= {f"{name}_{i + 1}": values[:, i] for i in range(values.shape[1])}
    return flat


def write_parquet(log: RobotLog, folder: Path | str) -> list[Path]:
    """One parquet file a topic, and one for the events.

    Returns:
        The files.

    Raises:
        ConfigError: pyarrow is not installed.
    """
    try:
        from pyarrow import parquet, table
    except ImportError as error:
        raise ConfigError("parquet needs pyarrow: pip install pyarrow") from error
    tables = {}
    if log.events:
        tables["events"] = table({key: [_cell(event[key]) for event in log.events] for key in log.events[0]})
    for topic, rows in log.topics.items():
        name = re.sub(r"[^A-Za-z0-9_.-]", "_", topic.strip("/"))[:LONGEST_NAME] or "_"
        while name in tables:
            name += "_"
        tables[name] = table(columns(rows))
    written = []
    for name, content in tables.items():
        path = Path(folder) / f"{name}.parquet"
        with _writing(path) as draft, draft.open("wb") as file:
            parquet.write_table(content, file)
        written.append(path)
    return written


def _cell(value: object) -> object:
    return for_spreadsheet(for_terminal(value)) if isinstance(value, str) else value


@contextmanager
def _writing(path: Path) -> Iterator[Path]:
    """`draft_of`; raises DataError where it cannot be written."""
    try:
        with draft_of(path) as draft:
            yield draft
    except OSError as error:
        raise DataError(f"{path} cannot be written: {in_a_line(error)}") from error


def _timed(log: RobotLog, topic: str, *fields: str) -> NDArray[np.void]:
    """The messages of a topic with a time.

    Raises:
        DataError: There are none, or they lack a field.
    """
    rows = log.topic(topic)
    for name in ("time", *fields):
        if name not in (rows.dtype.names or ()) or rows.dtype[name].ndim != (name not in SCALARS):
            raise DataError(f"{topic} of the log has no {name}")
    return rows[np.isfinite(rows["time"])]


def write_rerun(log: RobotLog, path: Path | str) -> Path:
    """A recording for the rerun viewer: bodies and target in space, and the run's curves over its time.

    Raises:
        ConfigError: rerun-sdk is not installed.
        DataError: The log has no measurements.
    """
    try:
        import rerun
    except ImportError as error:
        raise ConfigError("this needs the rerun viewer: pip install rerun-sdk") from error
    with _writing(Path(path)) as draft:
        recording = rerun.RecordingStream("apcc_torch")
        recording.save(str(draft))
        for row in _timed(log, "/measurement", "poses"):
            recording.set_time("time", duration=float(row["time"]))
            poses = row["poses"][: 16 * (len(row["poses"]) // 16)].reshape(-1, 4, 4)
            recording.log("bodies", rerun.Points3D(poses[:, :3, 3], radii=0.01))
        for row in _timed(log, "/target", "x_d"):
            recording.set_time("time", duration=float(row["time"]))
            recording.log("target", rerun.Points3D(row["x_d"][None, :3], radii=0.008))
        curves = {"/controller": ("e", "pi_hat"), "/tendons": ("y", "sent", "effort"), "/timing": ("lateness",)}
        for topic, names in curves.items():
            for row in _timed(log, topic, *names):
                recording.set_time("time", duration=float(row["time"]))
                for name in names:
                    recording.log(name, rerun.Scalars(np.atleast_1d(row[name])))
        recording.flush()
        recording.disconnect()
    return Path(path)


def write_recording(log: RobotLog, path: Path | str) -> Path:
    """The log as a recording that `simulate experiment=replay` and `identify` read: every new frame of the bodies.

    Columns u are the lengths that the tendons were told to pull in, phi those that were measured, m; of chambers their
    pressures, Pa.

    Raises:
        DataError: The log lacks measurements or tendons.
    """
    save_recording(recording_of(log, str(path)), path)
    return Path(path)


def recording_of(log: RobotLog, source: str = "") -> Recording:
    """The log as a recording: every new frame of the bodies.

    Inputs are the lengths that the tendons were told to pull in, actuators those that were measured, m. Of chambers
    both are their gauge pressures, Pa.

    Raises:
        DataError: The log lacks measurements or tendons.
    """
    frames = _timed(log, "/measurement", "poses", "position_ok", "orientation_ok", "sequence", "tick")
    tendons = _timed(log, "/tendons", "y", "sent", "tick")
    _, first = np.unique(frames["sequence"], return_index=True)
    frames = frames[first]
    at = np.searchsorted(tendons["tick"], frames["tick"], side="right") - 1
    frames, at = frames[at >= 0], at[at >= 0]
    if not len(frames):
        raise DataError("the log has no frame of the bodies while their tendons were read")
    poses = torch.from_numpy(frames["poses"].reshape(len(frames), -1, 4, 4).copy())
    ok = torch.from_numpy((frames["position_ok"] & frames["orientation_ok"]).astype(bool))
    # A tendon that is pulled in gets shorter, y < 0; a pressure pushes as it stands.
    sign = 1.0 if log.of_pressures else -1.0
    return Recording(
        tuple(f"body{k + 1}" for k in range(poses.shape[1])),
        torch.from_numpy(frames["time"].copy()),
        poses[..., :3, 3],
        rotation_quaternion(poses[..., :3, :3]),
        ok,
        sign * torch.from_numpy(tendons["sent"][at].copy()),
        sign * torch.from_numpy(tendons["y"][at].copy()),
        source=source,
    )
