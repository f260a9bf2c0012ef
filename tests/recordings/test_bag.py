"""Bags of ROS 2: topics are bodies and inputs, by the times of their headers."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.recordings.recording_file import detect_layout, load_recording

pytest.importorskip("rosbags")

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
NS = 1_000_000_000


def header(stamp: float) -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](sec=int(stamp), nanosec=round((stamp - int(stamp)) * NS))
    return TYPES["std_msgs/msg/Header"](stamp=time, frame_id="world")


def pose(x: float, y: float, z: float) -> Any:
    place = TYPES["geometry_msgs/msg/Point"](x=x, y=y, z=z)
    turn = TYPES["geometry_msgs/msg/Quaternion"](x=0.6, y=0.0, z=0.0, w=0.8)
    return TYPES["geometry_msgs/msg/Pose"](position=place, orientation=turn)


def stamped(stamp: float, x: float) -> Any:
    return TYPES["geometry_msgs/msg/PoseStamped"](header=header(stamp), pose=pose(x, 0.0, -0.1))


def joints(stamp: float, *angles: float) -> Any:
    values = np.array(angles)
    return TYPES["sensor_msgs/msg/JointState"](
        header=header(stamp), name=["a", "b"], position=values, velocity=0 * values, effort=0 * values
    )


def array(*values: float) -> Any:
    layout = TYPES["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return TYPES["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.array(values))


def poses(stamp: float, *places: float) -> Any:
    return TYPES["geometry_msgs/msg/PoseArray"](header=header(stamp), poses=[pose(x, 0.0, 0.0) for x in places])


def write(path: Path, messages: list[tuple[str, float, Any]], mcap: bool = True) -> Path:
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as bag:
        kinds = {topic: message.__msgtype__ for topic, _, message in messages}
        topics = {topic: bag.add_connection(topic, kind, typestore=STORE) for topic, kind in kinds.items()}
        for topic, received, message in messages:
            bag.write(topics[topic], round(received * NS), STORE.serialize_cdr(message, message.__msgtype__))
    return path


def arm(late: float = 0.5) -> list[tuple[str, float, Any]]:
    """Two bodies at 10 Hz, of which the second loses a frame, and joints at 5 Hz; the bag hears all of it late."""
    told: list[tuple[str, float, Any]] = []
    for i in range(6):
        at = 100.0 + 0.1 * i
        if i % 2 == 0:
            told.append(("/joints", at + late, joints(at - 0.01, 0.1 * i, 1.0)))
            told.append(("/command", at + late, array(1.0 * i, 2.0, 3.0)))
        told.append(("/low", at + late, stamped(at, 0.01 * i)))
        if i != 3:
            told.append(("/top", at + late, stamped(at + 0.02, 0.02 * i)))
    return told


@pytest.mark.parametrize("mcap", [True, False])
def test_topics_are_bodies_and_inputs(mcap: bool, tmp_path: Path) -> None:
    path = write(tmp_path / "bag", arm(), mcap)
    assert detect_layout(path) == "bag"
    read = load_recording(path)
    assert read.names == ("/low", "/top")
    assert read.times.tolist() == pytest.approx([100.0 + 0.1 * i for i in range(6)])
    assert read.position[:, 0, 0].tolist() == pytest.approx([0.01 * i for i in range(6)])
    assert read.tracked[:, 1].tolist() == [True, True, True, False, True, True]
    assert read.quaternion[0, 0].tolist() == pytest.approx([0.6, 0.0, 0.0, 0.8])
    assert read.inputs is not None and read.inputs[:, 0].tolist() == pytest.approx([0.0, 0.0, 0.2, 0.2, 0.4, 0.4])
    chosen = load_recording(path, bodies=["/top"], inputs=["/comm*"], unit="mm", up="y")
    # An array has no header: it counts from when the bag heard of it, after the first half second.
    assert chosen.names == ("/top",) and chosen.inputs is not None and chosen.inputs.shape[1] == 3
    assert len(chosen) == 1 and chosen.position[0, 0].tolist() == pytest.approx([1e-4, 1e-4, 0.0])


def test_a_file_of_mcap_alone(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", arm())
    alone = shutil.copy(next(bag.glob("*.mcap")), tmp_path / "alone.mcap")
    assert load_recording(alone).names == ("/low", "/top")


def test_poses_of_an_array(tmp_path: Path) -> None:
    told = [("/bodies", 1.0 + i, poses(1.0 + i, 0.1 * i, 0.2 * i)) for i in range(3)]
    read = load_recording(write(tmp_path / "bag", told), bodies=["/bodies[1]", "/bodies[0]"])
    assert read.names == ("/bodies[1]", "/bodies[0]") and read.inputs is None
    assert read.position[2, :, 0].tolist() == pytest.approx([0.4, 0.2])


def said(path: Path) -> str | None:
    """What a bag is refused with; None where it is read."""
    try:
        load_recording(path)
    except DataError as error:
        return str(error)
    return None


def test_what_is_wrong_with_a_bag_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", arm())
    with pytest.raises(DataError, match=r"has no poses '/lov'; did you mean /low\?"):
        load_recording(path, bodies=["/lov"])
    with pytest.raises(DataError, match=r"has no topic of numbers '/joint'; did you mean /joints\?"):
        load_recording(path, inputs=["/joint"])
    with pytest.raises(ConfigError, match="nothing is called /motors"):
        load_recording(path, inputs=["/motors*"])
    none = write(tmp_path / "none", [("/command", 1.0, array(1.0))])
    with pytest.raises(DataError, match="has no topic of poses"):
        load_recording(none)
    file = next(path.glob("*.mcap"))
    whole = file.read_bytes()
    for cut in (0, 9, 200, len(whole) // 2, len(whole) - 9):
        file.write_bytes(whole[:cut])
        assert said(path) is None or str(said(path)).startswith(str(path))
    rng = torch.Generator().manual_seed(0)
    for _ in range(20):
        damaged = bytearray(whole)
        for at in torch.randint(len(whole), (5,), generator=rng).tolist():
            damaged[at] ^= 0x55
        file.write_bytes(bytes(damaged))
        assert "\n" not in str(said(path))
