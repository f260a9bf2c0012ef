"""Recordings of arms that never were, of any size, and files of them as labs lay them out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from apcc_torch.lie.rotations import rotation_quaternion
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.recordings.raw_poses import MIRRORED, UP, turned
from apcc_torch.recordings.recording import Recording

METRES = {"m": 1.0, "cm": 0.01, "mm": 1e-3, "in": 0.0254}
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
NAMES = {
    "named": ("{name}_{axis}", "{name}_q{axis}"),
    "dotted": ("{name}.{axis}", "{name}.q{axis}"),
    "numbered": ("{axis}{k}", "q{axis}{k}"),
    "turned round": ("{axis}_{name}", "q{axis}_{name}"),
    "ros": ("/{name}/pose/position/{axis}", "/{name}/pose/orientation/{axis}"),
    "declared": ("pos({name}){axis}", "quat({name}){axis}"),
}
"""Style -> columns of a position and of a quaternion; the last is none that names tell."""


def arm_of(size: float = 0.3, sections: int = 3) -> Arm:
    """A hanging arm of that length, m."""
    return Arm(lengths=[size / sections] * sections, mass=0.1, tendon_offset=0.02 * size)


def recorded(arm: Arm, frames: int = 60, bend: float = 0.6, dropped: float = 0.0, seed: int = 0) -> Recording:
    """Its bodies at the sections' ends, with marker frames of their own, in motion on all sides; z is upward.

    Args:
        arm: The arm.
        frames: How many.
        bend: Of a section, rad, at most about so much.
        dropped: Share of the poses that were not tracked.
        seed: Of random numbers.
    """
    rng = torch.Generator().manual_seed(seed)
    n = arm.n_sections
    time = torch.arange(frames, dtype=torch.float64) / 10.0
    phase = 2.0 * math.pi * torch.rand(2 * n, generator=rng, dtype=torch.float64)
    rate = 4.0 + 3.0 * torch.rand(2 * n, generator=rng, dtype=torch.float64)
    bends = bend * torch.sin(rate * time.unsqueeze(-1) + phase)
    q = torch.nn.functional.pad(bends.unflatten(-1, (n, 2)), (0, 1)).flatten(-2)
    T = arm.backbone().pose(q, arm.rest_lengths(), *decouple(arm.sensor_places(), arm.rest_lengths()))
    mounts = torch.randn(n, 4, generator=rng, dtype=torch.float64)
    quaternion = rotation_quaternion(T[..., :3, :3])
    quaternion = torch.stack(
        [turned_by(quaternion[:, k], torch.nn.functional.normalize(mounts[k], dim=0)) for k in range(n)], dim=1
    )
    tracked = torch.rand(frames, n, generator=rng) >= dropped
    tracked[0] = True
    return Recording(
        tuple(f"disk{chr(97 + k)}" for k in range(n)),
        time,
        torch.where(tracked.unsqueeze(-1), T[..., :3, 3], torch.nan),
        torch.where(tracked.unsqueeze(-1), quaternion, torch.nan),
        tracked,
        torch.randn(frames, 2, generator=rng, dtype=torch.float64),
    )


def turned_by(quaternion: Tensor, mount: Tensor) -> Tensor:
    """quaternion times mount (4,): the marker frame on the body."""
    conjugate = torch.tensor([-1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
    return conjugate * turned(conjugate * mount, conjugate * quaternion)


@dataclass(frozen=True)
class Layout:
    """How a file is written; `declared` says so to the reader."""

    style: str = "named"
    unit: str = "m"
    order: str = "xyzw"
    up: str = "z"
    hand: str = "right"
    delimiter: str = ","
    decimal: str = "."
    bom: bool = False
    time_unit: str = "s"
    comments: bool = False
    quaternions: bool = True
    shuffled: int = 0
    odd: tuple[str, ...] = field(default=())

    def declared(self, names: tuple[str, ...]) -> dict[str, Any]:
        """What a reader has to be told."""
        said: dict[str, Any] = {"unit": self.unit, "up": self.up, "hand": self.hand}
        said["time_unit"] = self.time_unit
        if self.style == "declared":
            said |= {"bodies": list(names), "position": "pos({body}){axis}"}
            said |= {"quaternion": "quat({body}){axis}"} if self.quaternions else {}
        return said


def in_the_file(recording: Recording, layout: Layout) -> tuple[Tensor, Tensor]:
    """Positions and quaternions (x, y, z, w) as the file's frame and unit have them."""
    frame = torch.tensor(UP[layout.up], dtype=torch.float64).mT
    position = recording.position @ frame.mT
    quaternion = turned(rotation_quaternion(frame), recording.quaternion)
    if layout.hand == "left":
        signs = torch.ones(3, dtype=torch.float64)
        signs[MIRRORED[layout.up[-1]]] = -1.0
        position = position * signs
        quaternion = torch.cat((-signs * quaternion[..., :3], quaternion[..., 3:]), dim=-1)
    return position / METRES[layout.unit], quaternion


def write(recording: Recording, path: Path, layout: Layout) -> Path:
    """The recording as a file."""
    position, quaternion = in_the_file(recording, layout)
    columns: dict[str, Tensor] = {"time": recording.times / SECONDS[layout.time_unit]}
    place, turn = NAMES[layout.style]
    for k, name in enumerate(recording.names):
        for i, axis in enumerate("xyz"):
            columns[place.format(name=name, axis=axis, k=k + 1)] = position[:, k, i]
        for axis in layout.order if layout.quaternions else "":
            columns[turn.format(name=name, axis=axis, k=k + 1)] = quaternion[:, k, "xyzw".index(axis)]
    if recording.inputs is not None:
        columns |= {f"u{i + 1}": recording.inputs[:, i] for i in range(recording.inputs.shape[1])}
    columns["battery"] = torch.full_like(recording.times, 12.5)
    names = list(columns)
    if layout.shuffled:
        moved = torch.randperm(len(names), generator=torch.Generator().manual_seed(layout.shuffled)).tolist()
        # Bodies are numbered by their first columns, which stay in order.
        kept = [n for n in names if n in place_of_x(recording, place)]
        names = [names[i] for i in moved]
        at = sorted(names.index(n) for n in kept)
        for i, n in zip(at, kept, strict=True):
            names[i] = n
        names = first_come(names, recording, layout)
    mark = layout.delimiter or "   "
    quote = '"' if layout.decimal == "," and layout.delimiter == "," else ""
    lines = [mark.join(f'"{n}"' if layout.delimiter in n and layout.delimiter else n for n in names)]
    if layout.comments:
        lines.insert(0, "# recorded on a Monday, 7 disks")
    for row in torch.stack([columns[n] for n in names], dim=-1).tolist():
        cells = ["nan" if math.isnan(x) and not layout.delimiter else "" if math.isnan(x) else repr(x) for x in row]
        cells = [f"{quote}{cell.replace('.', layout.decimal)}{quote}" for cell in cells]
        lines.append(mark.join(cells))
    if layout.comments:
        lines.insert(4, "# the cable was touched here")
    path.write_text(("\ufeff" if layout.bom else "") + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def place_of_x(recording: Recording, place: str) -> list[str]:
    """The first column of every body's position."""
    return [place.format(name=name, axis="x", k=k + 1) for k, name in enumerate(recording.names)]


def first_come(names: list[str], recording: Recording, layout: Layout) -> list[str]:
    """The columns with the first one of every body before all others of a body, and quaternions in their order."""
    first = [n for n in names if n in place_of_x(recording, NAMES[layout.style][0])]
    turn = NAMES[layout.style][1]
    for k, name in enumerate(recording.names):
        own = [turn.format(name=name, axis=axis, k=k + 1) for axis in layout.order]
        at = sorted(names.index(n) for n in own if n in names)
        for i, n in zip(at, own, strict=False):
            names[i] = n
    return first + [n for n in names if n not in first]
