"""Recordings of a real arm: the poses of bodies along it, with inputs and targets, read from and written to CSV files.

Layout "columns", for one's own recordings, is one CSV file with a header line, or a folder that holds it under the name
recording.csv. Columns may come in any order, and columns not named here are ignored:

    time                                          s, not decreasing
    <body>_x, <body>_y, <body>_z                  position in the recording frame, m
    <body>_qx, <body>_qy, <body>_qz, <body>_qw    unit quaternion that rotates the body's axes into the recording frame;
                                                  a body may lack all four, and has no orientation then
    <body>_tracked      optional                  1 or 0; where it is 0 the body's other cells may be empty
    u1, u2, ...         optional                  inputs sent to the actuators, in the actuators' own unit
    phi1, phi2, ...     optional                  what the actuators measured, in their own unit
    target_x, target_y, target_z   optional       target of the tip in the recording frame, m

Bodies are numbered from the base to the tip in the order in which their first columns appear.

Layout "trunk" is that of the trunk-stack recordings: observations_NAME.csv with the columns ID, x1, y1, z1, ..., qx1,
qy1, qz1, w1, ..., phi1, ... (m, motor angles in degrees) and, beside it, control_inputs_NAME.csv with ID, u1, ...
(degrees); it has no stamps, so the rate must be known. Observations may outnumber the inputs by one, the one after the
last input, which is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError, ShapeError
from apcc_torch.files import write_atomically
from apcc_torch.lie.rotations import quaternion_rotation
from apcc_torch.plain_text import for_spreadsheet
from apcc_torch.recordings.csv_table import CsvTable, read_table
from apcc_torch.shapes import check_stamps, check_tensor

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TARGET = ("target_x", "target_y", "target_z")
_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Recording:
    """T frames of k bodies, numbered from the base to the tip, in the recording frame.

    Attributes:
        names: The bodies' names, k of them.
        times: Time stamps in s, shape (T,).
        position: Body positions in m, shape (T, k, 3).
        quaternion: Unit quaternions (x, y, z, w), body axes into the recording frame, shape (T, k, 4); NaN where
            positions alone were recorded.
        tracked: Where the body was seen, bool, shape (T, k); elsewhere its pose may be NaN.
        inputs: Inputs sent to the actuators, shape (T, m), in the actuators' own unit.
        actuators: What the actuators measured, shape (T, m), in their own unit.
        target: Target of the tip in m, shape (T, 3).
        source: The file it came from.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> len(still), still.rotation[0, 1].diagonal()
        (50, tensor([ 1., -1., -1.], dtype=torch.float64))
    """

    names: tuple[str, ...]
    times: Tensor
    position: Tensor
    quaternion: Tensor
    tracked: Tensor
    inputs: Tensor | None = None
    actuators: Tensor | None = None
    target: Tensor | None = None
    source: str = ""

    def __post_init__(self) -> None:
        for name in self.names:
            if not name or set(name) & set(',"\r\n') or name == "target" or self.names.count(name) > 1:
                raise DataError(f"names must be unique, without commas or quotes and none 'target', got {name!r}")
        T, k = len(check_stamps("times", check_tensor("times", self.times, (None,)))), len(self.names)
        check_tensor("position", self.position, (T, k, 3))
        check_tensor("quaternion", self.quaternion, (T, k, 4))
        if self.tracked.shape != (T, k) or self.tracked.dtype != torch.bool:
            raise ShapeError(f"tracked must be bool of shape {(T, k)}, got {tuple(self.tracked.shape)}")
        for name, value, width in (
            ("inputs", self.inputs, None),
            ("actuators", self.actuators, None),
            ("target", self.target, 3),
        ):
            if value is not None:
                check_tensor(name, value, (T, width))

    def __len__(self) -> int:
        return len(self.times)

    @property
    def rotation(self) -> Tensor:
        """Rotation matrices, body axes into the recording frame, shape (T, k, 3, 3)."""
        length = torch.linalg.vector_norm(self.quaternion, dim=-1, keepdim=True)
        return quaternion_rotation(self.quaternion / torch.where(length > 0, length, 1.0))


def _pose(table: CsvTable, columns: Sequence[str], tracked: Tensor) -> tuple[Tensor, Tensor]:
    """Position (T, 3) and quaternion (T, 4) from seven columns, checked where `tracked` (T,).

    Without any of the last four the quaternions are NaN.
    """
    position = table.finite(columns[:3], tracked)
    if not any(name in table.columns for name in columns[3:]):
        return position, position.new_full((len(position), 4), torch.nan)
    quaternion = table.finite(columns[3:], tracked)
    length = torch.linalg.vector_norm(quaternion, dim=-1)
    bad = ((length - 1).abs() > _UNIT_TOLERANCE) & tracked
    if bool(bad.any()):
        row = int(bad.nonzero()[0])
        what = f"the quaternion that begins here has length {float(length[row]):.6g}, not 1"
        raise table.fault(what, columns[3], row)
    return position, quaternion


def _load_columns(path: Path, rate: float) -> Recording:
    table = read_table(path / "recording.csv" if path.is_dir() else path)
    times = table.finite(["time"])[:, 0]
    backward = (times.diff() < 0).nonzero()
    if len(backward):
        raise table.fault("the time goes backward", "time", int(backward[0]) + 1)
    endings = tuple(f"_{part}" for part in _POSE)
    names = [c.rsplit("_", 1)[0] for c in table.columns if c.endswith(endings)]
    names = list(dict.fromkeys(name for name in names if name != "target"))
    if not names:
        raise table.fault("the column is missing (no body has a position)", "<body>_x")
    tracked, poses = [], []
    for name in names:
        flag = table.optional([f"{name}_tracked"])
        flag = torch.ones_like(times) if flag is None else flag[:, 0]
        odd = ((flag != 0) & (flag != 1)).nonzero()
        if len(odd):
            raise table.fault("the cell must be 0 or 1", f"{name}_tracked", int(odd[0]))
        tracked.append(flag == 1)
        poses.append(_pose(table, [f"{name}_{part}" for part in _POSE], tracked[-1]))
    return Recording(
        tuple(names),
        times,
        torch.stack([position for position, _ in poses], dim=1),
        torch.stack([quaternion for _, quaternion in poses], dim=1),
        torch.stack(tracked, dim=1),
        table.optional(table.numbered("u")),
        table.optional(table.numbered("phi")),
        table.optional(_TARGET),
        str(table.path),
    )


def _load_trunk(path: Path, rate: float) -> Recording:
    result = sorted(path.glob("observations_*.csv")) if path.is_dir() else [path]
    if len(result) != 1:
        raise DataError(f"{path}: holds {len(result)} files observations_*.csv where one is wanted")
    table = read_table(result[0])
    bodies = range(1, len(table.numbered("x")) + 1)
    if not bodies:
        raise table.fault("the column is missing", "x1")
    ids = table.finite(["ID"])[:, 0]
    gap = (ids != torch.arange(len(ids), dtype=ids.dtype)).nonzero()
    if len(gap):
        raise table.fault("the number must be that of the data line, counted from 0", "ID", int(gap[0]))
    everywhere = torch.ones(len(ids), dtype=torch.bool)
    poses = [_pose(table, [f"{part}{i}" for part in (*_POSE[:6], "w")], everywhere) for i in bodies]
    actuators, inputs, T = table.optional(table.numbered("phi")), None, len(ids)
    sent = result[0].with_name(result[0].name.replace("observations_", "control_inputs_", 1))
    if sent != result[0] and sent.is_file():
        commands = read_table(sent)
        inputs = commands.finite(commands.numbered("u") or ["u1"])
        T = len(inputs)
        if len(ids) not in (T, T + 1):
            raise commands.fault(f"holds {T} data lines where {result[0].name} holds {len(ids)}", "ID", T - 1)
    return Recording(
        tuple(f"disk{i}" for i in bodies),
        torch.arange(T, dtype=torch.float64) / rate,
        torch.stack([position for position, _ in poses], dim=1)[:T],
        torch.stack([quaternion for _, quaternion in poses], dim=1)[:T],
        torch.ones(T, len(bodies), dtype=torch.bool),
        inputs,
        actuators if actuators is None else actuators[:T],
        source=str(result[0]),
    )


LAYOUTS: dict[str, Callable[[Path, float], Recording]] = {"columns": _load_columns, "trunk": _load_trunk}


def detect_layout(path: str | Path) -> str:
    """ "trunk" for a trunk-stack file, or a folder that holds one; else "columns".

    Example:
        >>> detect_layout("run/observations_1.csv"), detect_layout("run/arm.csv")
        ('trunk', 'columns')
    """
    path = Path(path)
    names = [path.name, *(result.name for result in path.glob("observations_*.csv"))]
    return "trunk" if any(name.startswith("observations_") for name in names) else "columns"


def load_recording(path: str | Path, layout: str = "columns", rate: float = 100.0) -> Recording:
    """Reads a recording whole, in float64.

    Args:
        path: The file, or the folder that holds it.
        layout: "columns" or "trunk", as the module describes them.
        rate: Frames a second, for layouts without time stamps.

    Raises:
        ConfigError: `layout` or `rate` is not one there is.
        DataError: A file is missing or not in the layout; the sentence names the file, the column and the line.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> with TemporaryDirectory() as folder:
        ...     save_recording(still, Path(folder) / "still.csv")
        ...     load_recording(Path(folder) / "still.csv").names
        ('middle', 'tip')
    """
    if layout not in LAYOUTS:
        raise ConfigError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    if not (math.isfinite(rate) and rate > 0):
        raise ConfigError(f"rate must be positive, got {rate:g}")
    return LAYOUTS[layout](Path(path), rate)


def save_recording(recording: Recording, path: str | Path) -> None:
    """Writes a recording in the layout "columns", atomically, every number exactly.

    Args:
        recording: The recording.
        path: The file to write, or replace.

    Raises:
        DataError: A number is not finite, other than in the pose of a body that was not tracked.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> with TemporaryDirectory() as folder:
        ...     save_recording(still, Path(folder) / "still.csv")
        ...     load_recording(Path(folder) / "still.csv").names
        ('middle', 'tip')
    """
    pose = torch.cat((recording.position, recording.quaternion), dim=-1)
    bad = (~pose.isfinite().all(-1) & recording.tracked).nonzero()
    if len(bad):
        frame, k = (int(i) for i in bad[0])
        raise DataError(f"{path}: frame {frame} of body {recording.names[k]!r} is marked as tracked but is not finite")
    for name in ("times", "inputs", "actuators", "target"):
        value = getattr(recording, name)
        if value is not None and not bool(value.isfinite().all()):
            raise DataError(f"{path}: {name} is not finite")
    header, blocks = ["time"], [recording.times.unsqueeze(-1)]
    for k, name in enumerate(recording.names):
        header += [f"{name}_{part}" for part in (*_POSE, "tracked")]
        blocks += [pose[:, k], recording.tracked[:, k : k + 1]]
    for stem, values in (("u", recording.inputs), ("phi", recording.actuators)):
        if values is not None:
            header += [f"{stem}{i + 1}" for i in range(values.shape[-1])]
            blocks.append(values)
    if recording.target is not None:
        header += _TARGET
        blocks.append(recording.target)
    table = torch.cat([block.to(torch.float64) for block in blocks], dim=-1).tolist()
    flags = {i for i, name in enumerate(header) if name.endswith("_tracked")}
    lines = [",".join(map(for_spreadsheet, header))]
    for row in table:
        cells = (str(int(x)) if i in flags else repr(x) if math.isfinite(x) else "" for i, x in enumerate(row))
        lines.append(",".join(cells))
    write_atomically(path, "\n".join(lines) + "\n")
