"""Writes bags of ROS 2: a folder with an MCAP file and its metadata.yaml, as `ros2 bag` takes it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from apcc_torch.errors import ConfigError, DataError, in_a_line
from apcc_torch.files import draft_folder_of

SECOND = 10**9
WORLD = "world"
"""Frame of what is recorded."""


class BagFile:
    """A bag that is open for writing; `bag_file` makes one.

    Messages are of the types of ROS 2 Humble. Stamps are ns since 1970.
    """

    def __init__(self, writer: Any, store: Any) -> None:
        self.writer, self.store = writer, store
        self.connections: dict[str, Any] = {}
        self.own: dict[str, str] = {}

    def make(self, kind: str, **fields: Any) -> Any:
        """A message; `kind` such as geometry_msgs/msg/Point."""
        return self.store.types[kind](**fields)

    def add(self, topic: str, message: Any, stamp: int) -> None:
        """Writes a message."""
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        self.writer.write(self.connections[topic], stamp, self.store.serialize_cdr(message, kind))

    def declare(self, topic: str, kind: str, definition: str) -> None:
        """Makes a topic of messages of a type of one's own.

        Args:
            topic: Of the messages.
            kind: Name of their type.
            definition: The ROS 2 message definition.

        Raises:
            DataError: That is no type of ROS 2, or another one of that name is in the bag.
        """
        from rosbags.typesys import TypesysError, get_types_from_msg

        if self.own.setdefault(kind, definition) != definition:
            raise DataError(f"{topic} has another type of the name {kind} than a topic before it")
        try:
            self.store.register(get_types_from_msg(definition, kind))
            told = {"msgdef": definition, "rihs01": self.store.hash_rihs01(kind)}
        except (TypesysError, KeyError) as error:
            raise DataError(f"{topic} has no type of ROS 2 ({in_a_line(error)[:80]})") from error
        self.connections[topic] = self.writer.add_connection(topic, kind, **told)

    def add_encoded(self, topic: str, content: bytes, stamp: int) -> None:
        """Writes a message of a topic that was declared, as CDR."""
        self.writer.write(self.connections[topic], stamp, content)

    # Messages of more than one part

    def header(self, stamp: int, frame: str = WORLD) -> Any:
        """std_msgs/msg/Header."""
        return self.make("std_msgs/msg/Header", stamp=self.time(stamp), frame_id=frame)

    def time(self, stamp: int) -> Any:
        """builtin_interfaces/msg/Time."""
        seconds, rest = divmod(stamp, SECOND)
        return self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)

    def xyz(self, kind: str, values: Iterable[float]) -> Any:
        """A message of three numbers x, y, z, or of four with w: a point, a vector, a quaternion."""
        return self.make(kind, **dict(zip("xyzw", (float(value) for value in values), strict=False)))

    def pose(self, position: Iterable[float], quaternion: Iterable[float], stamp: int) -> Any:
        """geometry_msgs/msg/PoseStamped; the quaternion is x, y, z, w."""
        pose = self.make(
            "geometry_msgs/msg/Pose",
            position=self.xyz("geometry_msgs/msg/Point", position),
            orientation=self.xyz("geometry_msgs/msg/Quaternion", quaternion),
        )
        return self.make("geometry_msgs/msg/PoseStamped", header=self.header(stamp), pose=pose)

    def point(self, place: Iterable[float], stamp: int) -> Any:
        """geometry_msgs/msg/PointStamped."""
        point = self.xyz("geometry_msgs/msg/Point", place)
        return self.make("geometry_msgs/msg/PointStamped", header=self.header(stamp), point=point)

    def joints(self, names: Sequence[str], position: Iterable[float], stamp: int, **more: Iterable[float]) -> Any:
        """sensor_msgs/msg/JointState; `more` is velocity, effort."""
        values = {"velocity": (), "effort": ()} | more | {"position": position}
        arrays = {name: np.array([*value], dtype=np.float64) for name, value in values.items()}
        return self.make("sensor_msgs/msg/JointState", header=self.header(stamp), name=list(names), **arrays)


@contextmanager
def bag_file(path: Path | str) -> Iterator[BagFile]:
    """A new bag, which is there whole once the block has ended well, else not at all.

    Args:
        path: Its folder, which must not be there yet.

    Raises:
        ConfigError: rosbags is not installed.
        WriteError: The folder is there already, or cannot be written.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigError('bags are written by rosbags: pip install "apcc-torch[bags]"') from error
    with draft_folder_of(path) as draft, Writer(draft, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        yield BagFile(writer, get_typestore(Stores.ROS2_HUMBLE))
