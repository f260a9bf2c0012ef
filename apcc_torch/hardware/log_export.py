"""A log as other tools like it: parquet tables, or a recording for the rerun viewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apcc_torch.errors import ConfigError
from apcc_torch.files import draft_of
from apcc_torch.hardware.log_reader import RobotLog


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
    tables = {name.strip("/").replace("/", "_"): table(columns(rows)) for name, rows in log.topics.items()}
    if log.events:
        tables["events"] = table({key: [event[key] for event in log.events] for key in log.events[0]})
    written = []
    for name, content in tables.items():
        path = Path(folder) / f"{name}.parquet"
        with draft_of(path) as draft:
            parquet.write_table(content, draft)
        written.append(path)
    return written


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
    with draft_of(path) as draft:
        recording = rerun.RecordingStream("apcc_torch")
        recording.save(str(draft))
        for row in log.topic("/measurement"):
            recording.set_time("time", duration=float(row["time"]))
            recording.log("bodies", rerun.Points3D(row["poses"].reshape(-1, 4, 4)[:, :3, 3], radii=0.01))
        for row in log.topic("/target"):
            recording.set_time("time", duration=float(row["time"]))
            recording.log("target", rerun.Points3D(row["x_d"][None], radii=0.008))
        curves = {"/controller": ("e", "pi_hat"), "/tendons": ("y", "sent", "effort"), "/timing": ("lateness",)}
        for topic, names in curves.items():
            for row in log.topic(topic):
                recording.set_time("time", duration=float(row["time"]))
                for name in names:
                    recording.log(name, rerun.Scalars(np.atleast_1d(row[name])))
        recording.flush()
        recording.disconnect()
    return Path(path)
