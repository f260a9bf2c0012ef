"""Calibration of a recorded arm from its rest pose: where its base is, and how each sensor sits on its disk.

At rest the arm is taken as straight. The model's base frame has its z axis along the arm, from the base to the tip; at
rest the model's frame at abscissa s is then the base frame moved by s along z. Each sensor gets a constant mount, the
transform from the sensor's own frame to the model's frame at the sensor's abscissa, which makes the two equal at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from apcc_torch.errors import DataError, ValueRangeError
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.lie.rotations import chordal_mean, rotation_angle
from apcc_torch.recordings.recording import Recording
from apcc_torch.shapes import check_finite, check_positive, check_tensor

_FEWEST = 10  # frames of a rest that is told by stillness
_NOISE, _STILL = 3.0, 0.01  # of the noise, and of the largest motion: farther is no rest
_MOVED = 1e-3  # inputs count as moved when one leaves its first value by this share of its range


def poses_of(calibration: RestCalibration, recording: Recording) -> Tensor:
    """The recording's poses in the base frame, shape (T, k, 4, 4); untracked ones may be NaN.

    Raises:
        DataError: The recording's bodies are not the calibration's.
    """
    if recording.names != calibration.names:
        raise DataError(f"{recording.source}: has the bodies {recording.names}, the calibration {calibration.names}")
    # A body without orientations keeps the one that its mount takes for rest.
    still = (calibration.base_rotation @ calibration.mount_rotation.mT).to(recording.position)
    rotation = torch.where(unturned(recording)[:, None, None], still, recording.rotation)
    return calibration.poses(recording.position, rotation)


def unturned(recording: Recording) -> Tensor:
    """Which bodies have positions alone (k,)."""
    return recording.quaternion.isnan().all(-1).all(0)


def rest_frame_count(recording: Recording) -> int:
    """Number of frames before the inputs first move, all of them if they never do; without inputs, of still frames.

    Raises:
        ValueRangeError: The recording has no inputs, and nothing is still where it begins.
    """
    if recording.inputs is None:
        return still_frame_count(recording)
    u = recording.inputs
    moved = ((u - u[0]).abs() > _MOVED * (u.amax(0) - u.amin(0))).any(-1).nonzero()
    return int(moved[0]) if len(moved) else len(u)


def still_frame_count(recording: Recording) -> int:
    """Number of frames before a body first moves by more than its noise, and by more than a hundredth of all motion.

    Raises:
        ValueRangeError: There are fewer than ten.
    """
    position = torch.where(recording.tracked.unsqueeze(-1), recording.position, torch.nan)
    first = position[:_FEWEST]
    centre = first.nanmedian(0).values
    off = torch.linalg.vector_norm(position - centre, dim=-1)
    # Second differences tell noise from motion that is smooth.
    noise = torch.linalg.vector_norm(first.diff(dim=0).diff(dim=0), dim=-1).nanmedian(0).values.nan_to_num(0.0)
    reach = torch.maximum(_NOISE * noise, _STILL * off.nan_to_num(0.0).amax(0))
    moved = (off > reach).any(-1).nonzero()
    count = int(moved[0]) if len(moved) else len(off)
    if count < _FEWEST:
        raise ValueRangeError(
            f"rest must be given: {recording.source or 'the recording'} has no inputs to find it by, and moves from "
            "its first frames on"
        )
    return count


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
) -> RestCalibration:
    """Calibrates a recording from the frames in which the arm hangs at rest, straight.

    The rest position of a sensor is the median over the frames, its rest rotation their trimmed chordal mean. One with
    positions alone counts as turned as the base is, and its offset does not turn with it.

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

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> calibrate(still, rest=50, base_position=[0.0, 0.0, 0.0]).abscissae
        tensor([0.2000, 0.4500], dtype=torch.float64)
    """
    count = rest_frame_count(recording) if rest is None else rest
    if not 1 <= count <= len(recording):
        raise ValueRangeError(f"rest must be from 1 to the recording's {len(recording)} frames, got {count}")
    if base_position is not None and first_abscissa is not None:
        raise ValueRangeError("first_abscissa must not be given together with base_position")
    position, rotation = recording.position[:count], recording.rotation[:count]
    alone = unturned(recording)
    seen = recording.tracked[:count] & position.isfinite().all(-1)
    seen = seen & (alone | rotation.isfinite().flatten(-2).all(-1))
    points, turns, far, wide = [], [], [], []
    for k, name in enumerate(recording.names):
        if not bool(seen[:, k].any()):
            raise DataError(f"{recording.source}: {name!r} was never tracked in the {count} frames at rest")
        p, R = position[seen[:, k], k], rotation[seen[:, k], k]
        points.append(p.quantile(0.5, dim=0))
        turns.append(torch.eye(3, dtype=p.dtype) if bool(alone[k]) else chordal_mean(R))
        far.append(float(torch.linalg.vector_norm(p - points[-1], dim=-1).max()))
        wide.append(0.0 if bool(alone[k]) else float(rotation_angle(turns[-1], R).max()))
    P, R_rest = torch.stack(points), torch.stack(turns)
    z = _direction(P, direction)
    R_rest = torch.where(alone[:, None, None], _base_axes(z, forward), R_rest)
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
    rest_pose = RestCalibration.at_rest(recording.names, base, _base_axes(z, forward), P, R_rest)
    if not bool((rest_pose.abscissae > 0).all()):
        raise ValueRangeError("base_position must lie before the first sensor along the arm")
    if not offsets:
        rest_pose = replace(rest_pose, mount_offset=torch.zeros_like(P))
    return replace(rest_pose, rest_frames=count, rest_scatter_m=max(far), rest_scatter_rad=max(wide))
