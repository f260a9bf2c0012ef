"""Recordings in bags of ROS 1 and ROS 2, MCAP among them: topics of poses are bodies, of joints or arrays inputs.

Frames are the messages of the first body. Another body is tracked in a frame where it has a message of the same time,
to half a frame; an input is the last one before it. Times are those of the messages' headers, and where those are
empty, or there are none, the times at which the bag received them. Unless they are named, transforms are no bodies
where there are poses of another kind, nor is a topic `/target`, where the tip was to go, nor `/actuators` an input.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, DataError, in_a_line
from apcc_torch.recordings.column_names import matching
from apcc_torch.recordings.declaration import RecordingSettings
from apcc_torch.recordings.frames_read import FramesRead
from apcc_torch.recordings.raw_poses import RawPoses
from apcc_torch.settings import did_you_mean

BAGS = (".bag", ".mcap", ".db3")
"""What the names of bags end with; a bag of ROS 2 may also be a folder with metadata.yaml."""
METADATA = "metadata.yaml"
MOST_MESSAGES = 10**7
"""Most messages that are read."""
MOST_VALUES = 10**4
"""Most numbers, or poses, of a message."""
POSES = (
    *("Pose", "PoseStamped", "PoseWithCovarianceStamped", "PoseArray", "PointStamped", "Point"),
    *("TransformStamped", "Transform", "TFMessage", "Odometry"),
)
VALUES = ("JointState", "Float64MultiArray", "Float32MultiArray", "Int32MultiArray", "Float64", "Float32")
"""Kinds of messages, by the last part of their types' names."""
TRANSFORMS = "TFMessage"
ACTUATORS, TARGET = "/actuators", "/target"
"""Topics of what the actuators measured, and of where the tip was to go."""


def is_bag(path: Path) -> bool:
    """Whether a path is that of a bag."""
    return path.suffix in BAGS or (path / METADATA).is_file() or bool(path.is_dir() and _within(path))


def _within(path: Path) -> list[Path]:
    return sorted(each for each in path.iterdir() if each.suffix in BAGS)


@dataclass
class Track:
    """What a topic says, or a frame of it that has a name of its own: stamps, s, and rows of numbers.

    of_transform: Whether it is a transform.
    """

    stamps: list[float] = field(default_factory=list)
    rows: list[tuple[float, ...]] = field(default_factory=list)
    of_transform: bool = False

    def ordered(self) -> tuple[Tensor, Tensor]:
        """Stamps (N,) in order, and the rows (N, n) with them."""
        stamps = torch.tensor(self.stamps, dtype=torch.float64)
        at = stamps.argsort(stable=True)
        return stamps[at], torch.tensor(self.rows, dtype=torch.float64)[at]


def bag_frames(path: Path, settings: RecordingSettings, _: int | None = None) -> FramesRead:
    """Reads a bag.

    Raises:
        ConfigError: rosbags is not installed, or a topic is not there.
        DataError: The bag cannot be read, or has no poses.
    """
    poses, values = _tracks(path, set(settings.inputs))
    target = None if TARGET in settings.named or len(poses) == 1 else poses.pop(TARGET, None)
    actuators = None if ACTUATORS in settings.inputs else values.pop(ACTUATORS, None)
    names = settings.named or tuple(name for name in poses if not poses[name].of_transform) or tuple(poses)
    for name in names:
        if name not in poses:
            raise DataError(f"{path}: has no poses {name!r}{did_you_mean(name, poses)}")
    if not names:
        raise DataError(f"{path}: has no topic of poses")
    times = poses[names[0]].ordered()[0].unique()
    bodies = [_at_frames(poses[name], times) for name in names]
    inputs = _inputs(path, values, settings)
    held = None if not inputs else torch.cat([_held(track, times) for track in inputs], dim=-1)
    # Before an input's first message nobody knows what drives the arm.
    known = torch.ones(len(times), dtype=torch.bool) if held is None else held.isfinite().all(-1)
    if not bool(known.any()):
        raise DataError(f"{path}: has no pose of {names[0]!r} after the first message of every input")
    pose = torch.stack(bodies, dim=1)[known]
    tracked = pose[..., :3].isfinite().all(-1)
    return FramesRead(
        names,
        times[known],
        RawPoses(pose[..., :3], pose[..., 3:], tracked, ("xyzw",) * len(names)),
        None if held is None else held[known],
        _whole(actuators, times[known]),
        None if target is None else _whole(_first_three(target), times[known]),
        None,
        str(path),
    )


def _inputs(path: Path, values: dict[str, Track], settings: RecordingSettings) -> list[Track]:
    if not settings.inputs:
        return [next(iter(values.values()))] if values else []
    chosen = matching("inputs", settings.inputs, tuple(values))
    for name in chosen:
        if name not in values:
            raise DataError(f"{path}: has no topic of numbers {name!r}{did_you_mean(name, values)}")
    return [values[name] for name in chosen]


def _at_frames(track: Track, times: Tensor) -> Tensor:
    """Poses (T, 7) at the times, NaN where the nearest one is half a frame away or more."""
    stamps, rows = track.ordered()
    after = torch.searchsorted(stamps, times).clamp(max=len(stamps) - 1)
    before = (after - 1).clamp(min=0)
    nearest = torch.where((stamps[after] - times).abs() < (times - stamps[before]).abs(), after, before)
    step = float(times.diff().median()) if len(times) > 1 else math.inf
    near = (stamps[nearest] - times).abs() < 0.5 * step
    return torch.where(near.unsqueeze(-1), rows[nearest], torch.nan)


def _held(track: Track, times: Tensor) -> Tensor:
    """Values (T, n) of the last message up to each time; NaN before the first."""
    stamps, rows = track.ordered()
    at = torch.searchsorted(stamps, times, right=True) - 1
    return torch.where((at >= 0).unsqueeze(-1), rows[at.clamp(min=0)], torch.nan)


def _whole(track: Track | None, times: Tensor) -> Tensor | None:
    """Values (T, n) of the last message up to each time; None where there are none, or not from the first one on."""
    held = None if track is None else _held(track, times)
    return held if held is not None and bool(held.isfinite().all()) else None


def _first_three(track: Track) -> Track:
    return Track(track.stamps, [row[:3] for row in track.rows])


def _tracks(path: Path, wanted: set[str]) -> tuple[dict[str, Track], dict[str, Track]]:
    """Topics of poses and of values, or names within them, in the order of their first messages."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigError(f'{path} is a bag, which rosbags reads: pip install "apcc-torch[bags]"') from error
    poses: dict[str, Track] = {}
    values: dict[str, Track] = {}
    inside = path if not path.is_dir() or (path / METADATA).is_file() else next(iter(_within(path)), path)
    try:
        with AnyReader([inside], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            chosen = [c for c in reader.connections if _kind(c.msgtype) in (*POSES, *VALUES)]
            messages = reader.messages(chosen) if chosen else iter(())
            for count, (connection, received, raw) in enumerate(messages):
                if count >= MOST_MESSAGES:
                    raise DataError(f"{path}: has over {MOST_MESSAGES} messages of poses and values")
                message = reader.deserialize(raw, connection.msgtype)
                kind, topic = _kind(connection.msgtype), connection.topic
                found = _poses(kind, topic, message) if kind in POSES else _values(kind, topic, message)
                for name, stamp, row in found:
                    track = (poses if kind in POSES else values).setdefault(
                        name, Track(of_transform=kind == TRANSFORMS)
                    )
                    if track.rows and len(track.rows[0]) != len(row):
                        raise DataError(f"{path}: {name} has {len(track.rows[0])} numbers, later {len(row)}")
                    track.stamps.append(stamp or 1e-9 * received)
                    track.rows.append(row)
    except DataError:
        raise
    except AnyReaderError as error:
        raise DataError(f"{path}: is no bag that can be read ({in_a_line(error)})") from error
    except Exception as error:  # a damaged bag raises what zstd, sqlite, struct and the message's parser do
        raise DataError(f"{path}: is damaged, or no bag ({in_a_line(error)})") from error
    return poses, values


def _kind(msgtype: str) -> str:
    return msgtype.rsplit("/", 1)[-1]


def _stamp(message: Any) -> float:
    """Of a message's header, s; 0 where it has none."""
    header = getattr(message, "header", None)
    return 0.0 if header is None else header.stamp.sec + 1e-9 * header.stamp.nanosec


def _poses(kind: str, topic: str, message: Any) -> Iterator[tuple[str, float, tuple[float, ...]]]:
    """Name, stamp and pose of every body that a message tells of."""
    if kind == TRANSFORMS:
        for transform in _bounded(message.transforms):
            yield transform.child_frame_id, _stamp(transform), _numbers(transform.transform)
    elif kind == "PoseArray":
        for i, pose in enumerate(_bounded(message.poses)):
            yield f"{topic}[{i}]", _stamp(message), _numbers(pose)
    else:
        inner = message
        for name in ("pose", "transform", "point"):
            while hasattr(inner, name):  # a pose with its covariance holds a pose
                inner = getattr(inner, name)
        yield topic, _stamp(message), _numbers(inner)


def _numbers(pose: Any) -> tuple[float, ...]:
    """Position and quaternion; NaN where a quaternion is not there, or is zero."""
    place = getattr(pose, "position", None) or getattr(pose, "translation", None) or pose
    turn = getattr(pose, "orientation", None) or getattr(pose, "rotation", None)
    position = tuple(float(getattr(place, axis)) for axis in "xyz")
    quaternion = (math.nan,) * 4 if turn is None else tuple(float(getattr(turn, axis)) for axis in "xyzw")
    size = math.hypot(*quaternion)
    return (*position, *((value / size if size > 0 else math.nan) for value in quaternion))


def _values(kind: str, topic: str, message: Any) -> Iterator[tuple[str, float, tuple[float, ...]]]:
    data: Sequence[float] | Iterable[float] = message.position if kind == "JointState" else message.data
    numbers = _bounded([data] if kind in ("Float64", "Float32") else data)
    yield topic, _stamp(message), tuple(float(value) for value in numbers)


def _bounded(items: Any) -> Any:
    if len(items) > MOST_VALUES:
        raise DataError(f"a message holds {len(items)} numbers or poses, over {MOST_VALUES}")
    return items
