"""Calibration of a recorded arm from its rest pose: where its base is, and how each sensor sits on its disk.

At rest the arm is taken as straight. The model's base frame has its z axis along the arm, from the base to the tip; at
rest the model's frame at abscissa s is then the base frame moved by s along z. Each sensor gets a constant mount, the
transform from the sensor's own frame to the model's frame at the sensor's abscissa, which makes the two equal at rest.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.errors import DataError, ValueRangeError
from apcc_torch.files import write_atomically
from apcc_torch.shapes import check_finite, check_positive, check_tensor
from apcc_torch.simulation.recording import Recording

VERSION = 1
_KIND = "apcc_torch.calibration"
_MOVED = 1e-3  # inputs count as moved when one leaves its first value by this share of its range
_OUTLIER = 3.0  # frames whose rotation is this many times the median angle off the mean are left out of it


@dataclass(frozen=True)
class Calibration:
    """Constants that turn recorded poses of k sensors into poses of the model's frames in the base frame.

    Attributes:
        names: The sensors' names, k of them, from the base to the tip.
        base_position: The base frame's origin in the recording frame, m, shape (3,).
        base_rotation: The base frame's axes in the recording frame as columns, shape (3, 3).
        mount_rotation: The model frame's axes in each sensor's frame as columns, shape (k, 3, 3).
        mount_offset: The model frame's origin in each sensor's frame, m, shape (k, 3).
        abscissae: Rest distance from the base along the arm of each sensor, m, shape (k,).
        rest_frames: Number of frames the calibration was computed from.
        rest_scatter_m: Largest distance of a rest frame's position from the rest position, m.
        rest_scatter_rad: Largest angle of a rest frame's rotation from the rest rotation, rad.
    """

    names: tuple[str, ...]
    base_position: Tensor
    base_rotation: Tensor
    mount_rotation: Tensor
    mount_offset: Tensor
    abscissae: Tensor
    rest_frames: int = 0
    rest_scatter_m: float = 0.0
    rest_scatter_rad: float = 0.0

    @property
    def rest_lengths(self) -> Tensor:
        """Rest lengths from the base to the first sensor, and from each sensor to the next, m, shape (k,)."""
        return torch.diff(self.abscissae, prepend=self.abscissae.new_zeros(1))

    def poses(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Poses of the model's frames at the sensors' abscissae.

        Args:
            position: Sensor positions in the recording frame, m, shape (..., k, 3).
            rotation: Sensor axes in the recording frame as columns, shape (..., k, 3, 3).

        Returns:
            Poses in the base frame, shape (..., k, 4, 4).
        """
        k = len(self.names)
        check_tensor("position", position, (k, 3))
        check_tensor("rotation", rotation, (k, 3, 3))
        to_base = self.base_rotation.mT.to(rotation)
        R = to_base @ rotation @ self.mount_rotation.to(rotation)
        point = position + (rotation @ self.mount_offset.to(rotation).unsqueeze(-1)).squeeze(-1)
        t = to_base @ (point - self.base_position.to(position)).unsqueeze(-1)
        bottom = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*R.shape[:-2], 1, 4)
        return torch.cat((torch.cat((R, t), dim=-1), bottom), dim=-2)

    def points(self, position: Tensor) -> Tensor:
        """Points of the recording frame (..., 3), such as targets, in the base frame, m."""
        return (check_tensor("position", position, (3,)) - self.base_position.to(position)) @ self.base_rotation.to(
            position
        )

    def apply(self, recording: Recording) -> Tensor:
        """The recording's poses in the base frame, shape (T, k, 4, 4); untracked ones may be NaN.

        Raises:
            DataError: The recording's bodies are not the calibration's.
        """
        if recording.names != self.names:
            raise DataError(f"{recording.source}: has the bodies {recording.names}, the calibration {self.names}")
        return self.poses(recording.position, recording.rotation)

    def content(self) -> dict[str, object]:
        """Plain values for a file, every number exactly; `of` takes them."""
        content: dict[str, object] = {"kind": _KIND, "version": VERSION}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            content[field.name] = value.tolist() if isinstance(value, Tensor) else value
        return content

    def save(self, path: str | Path) -> None:
        """Writes the calibration as JSON, atomically, every number exactly."""
        write_atomically(path, json.dumps(self.content(), indent=1) + "\n")

    @staticmethod
    def load(path: str | Path) -> Calibration:
        """Reads a calibration written by `save`, in float64.

        Raises:
            DataError: The file is missing, damaged, or of another kind or version.
        """
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror})") from error
        except ValueError as error:
            raise DataError(f"{path}: is not a JSON file ({error})") from error
        return Calibration.of(content, path)

    @staticmethod
    def of(content: object, path: str | Path) -> Calibration:
        """The calibration that `content` gave, in float64.

        Args:
            content: Plain values.
            path: The file they came from, for messages.

        Raises:
            DataError: They are damaged, or of another kind or version.
        """
        if not isinstance(content, dict) or content.get("kind") != _KIND:
            raise DataError(f"{path}: is not a calibration")
        if content.get("version") != VERSION:
            raise DataError(f"{path}: has version {content.get('version')!r}, this program reads {VERSION}")
        try:
            names = tuple(str(name) for name in content["names"])
            k = len(names)
            shapes = {
                "base_position": (3,),
                "base_rotation": (3, 3),
                "mount_rotation": (k, 3, 3),
                "mount_offset": (k, 3),
                "abscissae": (k,),
            }
            tensors = {
                key: torch.tensor(content[key], dtype=torch.float64).reshape(shape) for key, shape in shapes.items()
            }
            return Calibration(
                names,
                **{key: check_finite(key, value) for key, value in tensors.items()},
                rest_frames=int(content["rest_frames"]),
                rest_scatter_m=float(content["rest_scatter_m"]),
                rest_scatter_rad=float(content["rest_scatter_rad"]),
            )
        except KeyError as error:
            raise DataError(f"{path}: lacks the entry {error}") from error
        except (TypeError, ValueError, RuntimeError) as error:
            raise DataError(f"{path}: holds an entry of the wrong form ({error})") from error


def rest_frame_count(recording: Recording) -> int:
    """Number of frames before the inputs first move; all of them if they never do.

    Raises:
        ValueRangeError: The recording has no inputs.
    """
    if recording.inputs is None:
        raise ValueRangeError(f"rest must be given: {recording.source or 'the recording'} has no inputs to find it by")
    u = recording.inputs
    moved = ((u - u[0]).abs() > _MOVED * (u.amax(0) - u.amin(0))).any(-1).nonzero()
    return int(moved[0]) if len(moved) else len(u)


def chordal_mean(rotations: Tensor) -> Tensor:
    """The rotation (3, 3) nearest to the sum of rotations (N, 3, 3), a robust mean after one trimming.

    Frames whose angle from the first mean is above three times the median angle are left out of the second.
    """

    def nearest(total: Tensor) -> Tensor:
        U, _, Vh = torch.linalg.svd(total)
        sign = torch.ones(3, dtype=total.dtype, device=total.device)
        sign[-1] = torch.det(U @ Vh)
        return (U * sign) @ Vh

    first = nearest(rotations.sum(0))
    angle = rotation_angle(first, rotations)
    return nearest(rotations[angle <= _OUTLIER * angle.median() + 1e-9].sum(0))


def rotation_angle(a: Tensor, b: Tensor) -> Tensor:
    """The angle in rad between rotations (..., 3, 3); from the chord, so that small angles keep their digits."""
    chord = torch.linalg.matrix_norm(a - b) / math.sqrt(8.0)
    return 2 * torch.asin(chord.clamp(max=1.0))


def _direction(points: Tensor, direction: Sequence[float] | Tensor | None) -> Tensor:
    """The unit vector along the resting arm, from the base to the tip."""
    if direction is not None:
        given = torch.as_tensor(direction, dtype=points.dtype)
        check_positive("direction's length", torch.linalg.vector_norm(check_tensor("direction", given, (3,))))
        return given / torch.linalg.vector_norm(given)
    if len(points) < 2:
        raise ValueRangeError("direction must be given where there is a single sensor")
    line = torch.linalg.svd(points - points.mean(0))[2][0]
    return line * torch.sign(line @ (points[-1] - points[0]))


def _base_axes(z: Tensor, forward: Sequence[float] | Tensor | None) -> Tensor:
    """The right-handed axes (3, 3), as columns, with the given z and with x as near to `forward` as may be."""
    if forward is None:
        # The recording frame's x axis, or its y axis where the arm lies along x.
        forward = [1.0, 0.0, 0.0] if abs(float(z[0])) < 0.9 else [0.0, 1.0, 0.0]
    given = torch.as_tensor(forward, dtype=z.dtype)
    x = check_tensor("forward", given, (3,)) - (given @ z) * z
    length = torch.linalg.vector_norm(x)
    if not float(length) > 1e-3 * float(torch.linalg.vector_norm(given)):
        raise ValueRangeError("forward must not lie along the arm")
    x = x / length
    return torch.stack((x, torch.linalg.cross(z, x), z), dim=-1)


def calibrate(
    recording: Recording,
    rest: int | None = None,
    direction: Sequence[float] | Tensor | None = None,
    forward: Sequence[float] | Tensor | None = None,
    base_position: Sequence[float] | Tensor | None = None,
    first_abscissa: float | None = None,
    offsets: bool = True,
) -> Calibration:
    """Calibrates a recording from the frames in which the arm hangs at rest, straight.

    The rest position of a sensor is the median over the frames, its rest rotation their trimmed chordal mean.

    Args:
        recording: The recording.
        rest: Number of frames at the start in which the arm is at rest; None: those before the inputs first move.
        direction: Direction of the resting arm, base to tip, in the recording frame, shape (3,); give the direction of
            gravity where the arm hangs and the sensors sit beside its axis. None: the line through the sensors.
        forward: Direction in the recording frame that the base's x axis follows; None: the recording's x axis, or its
            y axis where the arm lies along x.
        base_position: The base in the recording frame, m, shape (3,). None: on the line along `direction` through the
            mean of the sensors, `first_abscissa` before the first of them.
        first_abscissa: Distance from the base to the first sensor, m; not with `base_position`. None: the mean spacing
            of the sensors, so an unmeasured base is extrapolated from an evenly divided arm.
        offsets: Whether mounts also move the sensors' origins onto the arm's axis, so that rest poses are the model's
            exactly; if not, mounts only rotate.

    Raises:
        ValueRangeError: An argument is out of its range, or needed and not given.
        DataError: A sensor was never tracked at rest, or the sensors are not in order along the arm.
    """
    count = rest_frame_count(recording) if rest is None else rest
    if not 1 <= count <= len(recording):
        raise ValueRangeError(f"rest must be from 1 to the recording's {len(recording)} frames, got {count}")
    if base_position is not None and first_abscissa is not None:
        raise ValueRangeError("first_abscissa must not be given together with base_position")
    position, rotation = recording.position[:count], recording.rotation[:count]
    seen = recording.tracked[:count] & position.isfinite().all(-1) & rotation.isfinite().flatten(-2).all(-1)
    points, turns, far, wide = [], [], [], []
    for k, name in enumerate(recording.names):
        if not bool(seen[:, k].any()):
            raise DataError(f"{recording.source}: {name!r} was never tracked in the {count} frames at rest")
        p, R = position[seen[:, k], k], rotation[seen[:, k], k]
        points.append(p.quantile(0.5, dim=0))
        turns.append(chordal_mean(R))
        far.append(float(torch.linalg.vector_norm(p - points[-1], dim=-1).max()))
        wide.append(float(rotation_angle(turns[-1], R).max()))
    P, R_rest = torch.stack(points), torch.stack(turns)
    z = _direction(P, direction)
    along = P @ z
    if bool((along.diff() <= 0).any()):
        raise DataError(f"{recording.source}: at rest the bodies {recording.names} are not in order along the arm")
    if base_position is not None:
        base = check_finite(
            "base_position", check_tensor("base_position", torch.as_tensor(base_position, dtype=P.dtype), (3,))
        )
    else:
        if first_abscissa is None and len(P) < 2:
            raise ValueRangeError("first_abscissa must be given where there is a single sensor")
        first = float(along.diff().mean()) if first_abscissa is None else first_abscissa
        centre = P.mean(0)
        base = centre + (along[0] - first - centre @ z) * z
    abscissae = along - base @ z
    if not bool((abscissae > 0).all()):
        raise ValueRangeError("base_position must lie before the first sensor along the arm")
    axes = _base_axes(z, forward)
    beside = base + abscissae.unsqueeze(-1) * z - P
    offset = (R_rest.mT @ beside.unsqueeze(-1)).squeeze(-1) if offsets else torch.zeros_like(P)
    return Calibration(recording.names, base, axes, R_rest.mT @ axes, offset, abscissae, count, max(far), max(wide))
