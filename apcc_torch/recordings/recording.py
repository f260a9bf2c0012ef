"""A recording of a real arm: the poses of bodies along it, with inputs and targets; written as a CSV file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.errors import DataError, ShapeError
from apcc_torch.files import write_atomically
from apcc_torch.lie.rotations import quaternion_rotation
from apcc_torch.plain_text import for_spreadsheet
from apcc_torch.shapes import check_stamps, check_tensor

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TARGET = ("target_x", "target_y", "target_z")


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
        groups: The same number for frames of one movement, int64, shape (T,).
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
    groups: Tensor | None = None
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


def save_recording(recording: Recording, path: str | Path) -> None:
    """Writes a recording as `load_recording` reads it without a declaration, atomically, every number exactly.

    Groups are left out.

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
    width = [3 if bool(recording.quaternion[:, k].isnan().all()) else 7 for k in range(len(recording.names))]
    for k, name in enumerate(recording.names):
        bad = (~pose[:, k, : width[k]].isfinite().all(-1) & recording.tracked[:, k]).nonzero()
        if len(bad):
            raise DataError(f"{path}: frame {int(bad[0])} of body {name!r} is marked as tracked but is not finite")
    for name in ("times", "inputs", "actuators", "target"):
        value = getattr(recording, name)
        if value is not None and not bool(value.isfinite().all()):
            raise DataError(f"{path}: {name} is not finite")
    header, blocks = ["time"], [recording.times.unsqueeze(-1)]
    for k, name in enumerate(recording.names):
        header += [f"{name}_{part}" for part in (*_POSE[: width[k]], "tracked")]
        blocks += [pose[:, k, : width[k]], recording.tracked[:, k : k + 1]]
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
