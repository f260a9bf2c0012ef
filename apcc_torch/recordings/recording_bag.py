"""Recordings as bags of ROS 2, which `load_recording` and every ROS tool read."""

from __future__ import annotations

import re
from pathlib import Path

from apcc_torch.errors import DataError
from apcc_torch.recordings.bag import ACTUATORS, TARGET
from apcc_torch.recordings.bag_file import SECOND, BagFile, bag_file
from apcc_torch.recordings.recording import Recording

INPUTS = "/inputs"
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
"""What the name of a ROS topic may be, between two slashes."""
LATEST = 2**31 - 1
"""Last second that a header of ROS 2 holds."""


def save_bag(recording: Recording, path: Path | str) -> Path:
    """Writes a recording as a bag that `load_recording` reads without a declaration; times to a nanosecond.

    Each body is a topic of poses of its name, `/inputs` and `/actuators` are joints, and `/target` is a point. A body
    that is not tracked has a pose of NaN. Groups are left out.

    Args:
        recording: The recording.
        path: The bag's folder, which must not be there yet.

    Raises:
        ConfigError: rosbags is not installed.
        DataError: A name is none of a topic, or a time none of a header.
        WriteError: The folder is there already, or cannot be written.

    Example:
        >>> place = torch.tensor([[0.0, 0.0, -0.2], [0.0, 0.0, -0.45]]).double().expand(50, 2, 3)
        >>> turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).double().expand(50, 2, 4)
        >>> still = Recording(("middle", "tip"), torch.arange(50).double() / 100, place, turn, torch.ones(50, 2).bool())
        >>> with TemporaryDirectory() as folder:
        ...     load_recording(save_bag(still, Path(folder) / "still")).names
        ('/middle', '/tip')
    """
    with bag_file(path) as bag:
        add_recording(bag, recording)
    return Path(path)


def add_recording(bag: BagFile, recording: Recording, began: int = 0) -> None:
    """Writes a recording's messages into a bag.

    Args:
        bag: Open.
        recording: The recording.
        began: When its time was zero, ns since 1970.

    Raises:
        DataError: A name is none of a topic, or a time none of a header.
    """
    topics = [f"/{name.removeprefix('/')}" for name in recording.names]
    for topic in topics:
        if not all(NAME.fullmatch(part) for part in topic[1:].split("/")) or topic in (INPUTS, ACTUATORS, TARGET):
            raise DataError(f"names must be those of topics of ROS, of letters, digits and _, got {topic[1:]!r}")
    stamps = [began + round(SECOND * time) for time in recording.times.tolist()]
    if stamps and not 0 <= min(stamps) <= max(stamps) < LATEST * SECOND:
        raise DataError("times must be from 0 to 2^31 s: a header of ROS holds no others")
    pose = recording.position.tolist(), recording.quaternion.tolist(), recording.tracked.tolist()
    joints = [(INPUTS, recording.inputs), (ACTUATORS, recording.actuators)]
    values = [(topic, value.tolist()) for topic, value in joints if value is not None]
    targets = None if recording.target is None else recording.target.tolist()
    lost = [float("nan")] * 4
    for k, (stamp, places, turns, tracked) in enumerate(zip(stamps, *pose, strict=True)):
        for topic, rows in values:
            names = [f"{topic[1:-1]}_{i + 1}" for i in range(len(rows[k]))]
            bag.add(topic, bag.joints(names, rows[k], stamp), stamp)
        for topic, place, turn, seen in zip(topics, places, turns, tracked, strict=True):
            bag.add(topic, bag.pose(place if seen else lost[:3], turn if seen else lost, stamp), stamp)
        if targets is not None:
            bag.add(TARGET, bag.point(targets[k], stamp), stamp)
