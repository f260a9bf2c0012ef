"""How columns are called that hold poses, times and inputs."""

from __future__ import annotations

import re
from typing import NamedTuple

POSE, TURN = r"(?:(?:pose|transform|point)\d*[._/])*", r"(?:orientation|rotation)"


class Style(NamedTuple):
    """How names of columns are made of a body's name and an axis: patterns of positions and of quaternions."""

    position: str
    quaternion: str


STYLES = (
    # ROS: tip.pose.position.x, /tip/pose/orientation/w
    Style(
        rf"(?:(?P<body>.+?)[._/])??{POSE}(?:position|translation)[._/](?P<axis>[xyz])",
        rf"(?:(?P<body>.+?)[._/])??{POSE}{TURN}[._/](?P<axis>[xyzw])",
    ),
    # x, qx, pos_x: one body
    Style(
        r"(?P<body>)(?:pos(?:ition)?[_.]?|p|t)?(?P<axis>[xyz])", r"(?P<body>)(?:q|quat(?:ernion)?)[_.]?(?P<axis>[xyzw])"
    ),
    # tip_x, tip.qx, tip pos x
    Style(
        r"(?P<body>.+?)[._/ :-](?:pos(?:ition)?[._ ]?|p|t)?(?P<axis>[xyz])",
        r"(?P<body>.+?)[._/ :-](?:q_?|quat(?:ernion)?[._ ]?)(?P<axis>[xyzw0-3])",
    ),
    # x1, x_1, qx1, and w1
    Style(r"(?:pos_?|p|t)?(?P<axis>[xyz])_?(?P<body>\d+)", r"(?:q_?(?=[xyzw])|(?=w))(?P<axis>[xyzw])_?(?P<body>\d+)"),
    # x_tip, qx_tip
    Style(r"(?:pos_?|p|t)?(?P<axis>[xyz])_(?P<body>[a-z]\w*)", r"q_?(?P<axis>[xyzw])_(?P<body>[a-z]\w*)"),
)
UNIT = re.compile(r"\s*[\[(]\s*(?P<a>[a-zµ]+)\s*[\])]$|[ _](?P<b>mm|cm|m|in|inch|ms|us|ns|s)$", re.IGNORECASE)
"""What may end a column's name and says its unit."""
NO_BODY = re.compile(
    r"(^|[._/ ])(target|goal|acc|accel|acceleration|gyro|vel|velocity|force|torque|wrench|omega|twist|"
    r"q|quat|quaternion|rot|rotation|orientation|euler|angle|roll|pitch|yaw|rpy)s?\d*$",
    re.IGNORECASE,
)
"""Names of what has axes and is no body."""
TARGET = ("target_x", "target_y", "target_z")
TIMES = (
    *("time", "times", "t", "time_stamp", "timestamp", "timestamps", "stamp", "__time"),
    *("seconds", "sec", "secs", "elapsed"),
)
NANOSECONDS = ("%time", "field.header.stamp")
"""Columns of times in ns, as rostopic writes them."""
COUNTS = ("frame", "frames", "frame#")
DRIVES = ("u", "motor", "tendon", "servo", "input", "pressure", "cmd", "command", "m")
"""What columns of inputs are called before their numbers; those of phi are what the actuators measured."""
ONE = "tip"
"""What a body without a name is called."""
