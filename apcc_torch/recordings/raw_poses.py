"""Poses as a file holds them, and what they are in metres, in a right-handed frame with z upward."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.lie import so3
from apcc_torch.lie.rotations import quaternion_rotation, rotation_quaternion
from apcc_torch.model.table import table
from apcc_torch.recordings.column_names import BodyColumns, Columns
from apcc_torch.recordings.csv_table import CsvTable
from apcc_torch.recordings.declaration import METRES, RecordingSettings

UP = {
    "z": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "y": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "x": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    "-z": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    "-y": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "-x": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
}
"""The file's axis that points up -> the rotation that turns it to z."""
MIRRORED = {"x": 2, "y": 2, "z": 1}
"""The axis that points up -> the one that a left hand's frame has the other way round."""
UNIT_TOLERANCE = 1e-2
"""By which a quaternion's length may be off one: files round."""


class Posed(NamedTuple):
    """Positions (T, k, 3), m, and unit quaternions (T, k, 4) x, y, z, w; NaN where there are none."""

    position: Tensor
    quaternion: Tensor


@dataclass(frozen=True)
class RawPoses:
    """T frames of k bodies as they stand in a file.

    position: (T, k, 3) in the file's unit and frame. quaternion: (T, k, 4) as it stands there; NaN where there is none.
    tracked: (T, k). order: Of the four, of each body. unit: m, where the file or the columns' names say it.
    """

    position: Tensor
    quaternion: Tensor
    tracked: Tensor
    order: tuple[str, ...]
    unit: float = 1.0

    def posed(self, settings: RecordingSettings) -> Posed:
        """What they are as declared."""
        k = self.position.shape[1]
        wanted = [settings.quaternion_order or order for order in self.order]
        turns = [self.quaternion[:, b, [wanted[b].index(axis) for axis in "xyzw"]] for b in range(k)]
        quaternion = torch.stack(turns, dim=1)
        position = placed(self.position, settings, self.unit)
        if settings.hand == "left":
            # The bodies' own axes are a left hand's too, and so mirrored with the frame.
            quaternion = torch.cat((-_signs(settings) * quaternion[..., :3], quaternion[..., 3:]), dim=-1)
        if settings.up not in (None, "z"):
            quaternion = turned(rotation_quaternion(_frame(settings)), quaternion)
        if settings.offsets is not None:
            quaternion_known = quaternion.isfinite().all(-1)
            if not bool((quaternion_known | ~self.tracked).any()):
                raise ConfigError("recording.offsets turn with their bodies, which have no orientation here")
            offsets = table("recording.offsets", settings.offsets, k, 3)
            position = position + (quaternion_rotation(quaternion) @ offsets.unsqueeze(-1)).squeeze(-1)
        return Posed(position, quaternion)


def placed(points: Tensor, settings: RecordingSettings, told: float = 1.0) -> Tensor:
    """Points (..., 3) of a file in m and in a right-handed frame, with z upward where `up` is declared.

    Args:
        points: In the file's unit and frame.
        settings: The declaration.
        told: The unit where it declares none, m.
    """
    points = points * metres(settings, told)
    if settings.hand == "left":
        points = points * _signs(settings)
    return points if settings.up is None else points @ _frame(settings).mT


def _frame(settings: RecordingSettings) -> Tensor:
    return torch.tensor(UP[settings.up or "z"], dtype=torch.float64)


def _signs(settings: RecordingSettings) -> Tensor:
    """(3,) of what mirrors a left hand's frame."""
    signs = torch.ones(3, dtype=torch.float64)
    signs[MIRRORED[(settings.up or "z")[-1]]] = -1.0
    return signs


def metres(settings: RecordingSettings, told: float = 1.0) -> float:
    """The unit of positions, m: as declared, else as the file says."""
    unit = settings.unit
    return told if unit is None else METRES[unit] if isinstance(unit, str) else float(unit)


def turned(turn: Tensor, quaternion: Tensor) -> Tensor:
    """Quaternions (..., 4) turned by another one (4,)."""
    v, w = turn[:3], turn[3]
    u, s = quaternion[..., :3], quaternion[..., 3:]
    return torch.cat((w * u + s * v + torch.linalg.cross(v.expand_as(u), u, dim=-1), w * s - (u @ v).unsqueeze(-1)), -1)


def raw_poses(table: CsvTable, columns: Columns, settings: RecordingSettings) -> RawPoses:
    """The poses in a table.

    A body is tracked where its column says so, else where its position is there. Where the column says so and a cell
    is empty, where a cell is infinite, and where a quaternion is not of length one, the file is wrong.

    Raises:
        DataError: It is; the sentence names the column and the line.
    """
    parts = [_body(table, body, columns, settings) for body in columns.bodies]
    position, quaternion, tracked = (torch.stack(values, dim=1) for values in zip(*parts, strict=True))
    order = tuple(body.order if len(body.turn) == 4 else "xyzw" for body in columns.bodies)
    for k, body in enumerate(columns.bodies):
        if not bool(tracked[:, k].any()):
            raise DataError(f"{table.path}: {body.name!r} was never tracked")
    return RawPoses(position, quaternion, tracked, order, columns.unit)


def _body(
    table: CsvTable, body: BodyColumns, columns: Columns, settings: RecordingSettings
) -> tuple[Tensor, Tensor, Tensor]:
    flag = None
    if body.tracked is not None:
        flag = table.finite([body.tracked])[:, 0]
        odd = ((flag != 0) & (flag != 1)).nonzero()
        if len(odd):
            raise table.fault("the cell must be 0 or 1", body.tracked, int(odd[0]))
    position = table.known(body.position) if flag is None else table.finite(body.position, flag == 1)
    tracked = position.isfinite().all(-1) & (flag != 0 if flag is not None else True)
    if columns.zero_untracked:
        tracked = tracked & (position != 0).any(-1)
    if flag is None:
        position = torch.where(tracked.unsqueeze(-1), position, torch.nan)
    quaternion = position.new_full((len(position), 4), torch.nan)
    if len(body.turn) == 4:
        quaternion = table.known(body.turn) if flag is None else table.finite(body.turn, flag == 1)
        length = torch.linalg.vector_norm(quaternion, dim=-1)
        if flag is None:  # a quaternion of zeros stands for none
            quaternion = torch.where((length > 0).unsqueeze(-1), quaternion, torch.nan)
        bad = ((length - 1).abs() > UNIT_TOLERANCE) & tracked & ((length > 0) | (flag is not None))
        if bool(bad.any()):
            row = int(bad.nonzero()[0])
            what = f"the quaternion that begins here has length {float(length[row]):.6g}, not 1"
            raise table.fault(what, body.turn[0], row)
    elif len(body.turn) == 9:
        matrix = table.known(body.turn).unflatten(-1, (3, 3)).mT
        quaternion = rotation_quaternion(matrix)
    elif len(body.turn) == 3:
        quaternion = rotation_quaternion(euler_rotation(table.known(body.turn), columns.euler_order, settings))
    if flag is None:
        quaternion = torch.where(tracked.unsqueeze(-1), quaternion, torch.nan)
    return position, quaternion, tracked


def euler_rotation(angles: Tensor, told: str | None, settings: RecordingSettings) -> Tensor:
    """Rotations (..., 3, 3) by three angles (..., 3) about a body's own axes, one after the other."""
    order = told or settings.euler_order
    turns = torch.deg2rad(angles) if settings.angle == "deg" or told is not None else angles
    unit = torch.eye(3, dtype=angles.dtype)
    first, second, third = (so3.exp(turns[..., k : k + 1] * unit["xyz".index(order[k])]) for k in range(3))
    return first @ second @ third
