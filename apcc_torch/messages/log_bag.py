"""The log of a run on an arm as a bag of ROS 2: bodies, tendons, target, frames, the arm's line, and all it holds."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from apcc_torch.errors import DataError
from apcc_torch.hardware.log_export import recording_of
from apcc_torch.hardware.log_format import EVENT_TOPIC, HEADER
from apcc_torch.hardware.log_reader import RobotLog
from apcc_torch.lie.rotations import rotation_quaternion
from apcc_torch.messages.foxglove_file import FAILURES, PREFIX, SCENE_PERIOD, numbers_at
from apcc_torch.messages.frames import BASE, TIP, turned
from apcc_torch.recordings.bag_file import SECOND, WORLD, BagFile, bag_file
from apcc_torch.recordings.recording_bag import add_recording
from apcc_torch.viewing.moment import Array
from apcc_torch.viewing.recorded import Recorded

FRAMES, LINE, REMARKS, TARGETS = "/tf", "/arm", "/remarks", "/target"
LINE_STRIP, INFO, ERROR = 4, 20, 40
"""Of visualization_msgs/msg/Marker, and levels of rcl_interfaces/msg/Log."""
COLOR = (0.0, 0.45, 0.7, 1.0)


def write_bag(log: RobotLog, path: Path | str, run: Recorded | None = None) -> Path:
    """Writes a log as a bag: what `load_recording` reads, and what a ROS tool shows.

    The bodies are topics of poses, `/inputs` the lengths that tendons were told to pull in and `/actuators` those that
    were measured, m, or pressures, Pa, as in `write_recording`. The log's own topics follow below `/log`, byte for
    byte. With the run, `/target` is the tip's, `/tf` has the arm's base and tip, and `/arm` its line for RViz.

    Args:
        log: The log; a topic whose type is none of ROS 2 is left out and named among its damage.
        path: The bag's folder, which must not be there yet.
        run: The log as a run; None where the settings of its controller cannot be had.

    Raises:
        ConfigError: rosbags is not installed.
        DataError: The log lacks measurements, tendons or what dates it.
        WriteError: The folder is there already, or cannot be written.
    """
    began, recording = log.began, recording_of(log)
    with bag_file(path) as bag:
        add_recording(bag, recording, began)
        if run is not None:
            _add_run(bag, run, began)
        for topic, rows in log.topics.items():
            layout = log.layouts[topic]
            try:
                bag.declare(PREFIX + topic, layout.schema_name, layout.definition)
            except DataError as error:
                log.damage.append(str(error))
                continue
            for row, stamp in zip(rows, log.stamps[topic].tolist(), strict=True):
                bag.add_encoded(PREFIX + topic, HEADER + row.tobytes(), stamp)
        for event, stamp in zip(log.events, log.stamps.get(EVENT_TOPIC, np.empty(0)).tolist(), strict=True):
            bag.add(REMARKS, _remark(bag, event, stamp), stamp)
    return Path(path)


def _add_run(bag: BagFile, run: Recorded, began: int) -> None:
    """Frames, target and line of every instant; lines are fewer."""
    base, shown = turned(run.arm.backbone.base_rotation.numpy()), -math.inf
    for k, time in enumerate(run.time.tolist()):
        stamp = began + round(SECOND * time)
        with torch.inference_mode():
            tip, numbers = numbers_at(run, k, 0)
        if not (math.isfinite(time) and np.isfinite(tip).all()):
            continue
        bag.add(FRAMES, _transforms(bag, {BASE: base, TIP: tip}, stamp), stamp)
        if np.isfinite(numbers.target).all():
            bag.add(TARGETS, bag.point(numbers.target, stamp), stamp)
        if time >= shown + SCENE_PERIOD - 1e-9:
            shown = time
            bag.add(LINE, _line(bag, run.moment(k, 0).sections.reshape(-1, 3), run.size.radius, stamp), stamp)


def _transforms(bag: BagFile, frames: dict[str, Array], stamp: int) -> Any:
    transforms = []
    for name, T in frames.items():
        turn = rotation_quaternion(torch.from_numpy(T[:3, :3].astype(np.float64)))
        transform = bag.make(
            "geometry_msgs/msg/Transform",
            translation=bag.xyz("geometry_msgs/msg/Vector3", T[:3, 3]),
            rotation=bag.xyz("geometry_msgs/msg/Quaternion", turn.tolist()),
        )
        told = {"header": bag.header(stamp), "child_frame_id": name, "transform": transform}
        transforms.append(bag.make("geometry_msgs/msg/TransformStamped", **told))
    return bag.make("tf2_msgs/msg/TFMessage", transforms=transforms)


def _line(bag: BagFile, points: Array, radius: float, stamp: int) -> Any:
    """visualization_msgs/msg/Marker of the arm's centre line."""
    none = bag.header(0, "")
    image = bag.make("sensor_msgs/msg/CompressedImage", header=none, format="", data=np.empty(0, dtype=np.uint8))
    pose = bag.pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp)
    r, g, b, a = COLOR
    return bag.make(
        "visualization_msgs/msg/Marker",
        header=bag.header(stamp, WORLD),
        ns="arm",
        id=0,
        type=LINE_STRIP,
        action=0,
        pose=pose.pose,
        scale=bag.xyz("geometry_msgs/msg/Vector3", (2.0 * radius, 0.0, 0.0)),
        color=bag.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=a),
        lifetime=bag.make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[bag.xyz("geometry_msgs/msg/Point", point) for point in points.tolist()],
        colors=[],
        texture_resource="",
        texture=image,
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=bag.make("visualization_msgs/msg/MeshFile", filename="", data=np.empty(0, dtype=np.uint8)),
        mesh_use_embedded_materials=False,
    )


def _remark(bag: BagFile, event: dict[str, object], stamp: int) -> Any:
    told = f"{event['state']}: {event['message']}"
    level = ERROR if event["reason"] in FAILURES else INFO
    more = {"file": "", "function": "", "line": 0}
    return bag.make(
        "rcl_interfaces/msg/Log", stamp=bag.time(stamp), level=level, name=str(event["kind"]), msg=told, **more
    )
