"""What the settings refuse, each named."""

from __future__ import annotations

import math

import pytest

from apcc_torch.errors import ApccError, ConfigError, ValueRangeError
from hardware.optitrack.streams import settings


def test_lists_of_a_configuration_file_become_tuples() -> None:
    s = settings(bodies=["a", "b"], base_offset=[0.0, 0.0, 0.1], base_quaternion=[0.0, 0.0, 1.0, 0.0])
    assert s.names == ("base", "a", "b") and s.base_offset == (0.0, 0.0, 0.1)
    assert hash(s) == hash(settings(bodies=("a", "b"), base_offset=(0.0, 0.0, 0.1), base_quaternion=(0, 0, 1, 0)))


def test_nothing_listens_beyond_loopback_by_default() -> None:
    s = settings()
    assert (s.interface, s.server, s.multicast) == ("127.0.0.1", "127.0.0.1", False)


@pytest.mark.parametrize(
    ("changes", "error", "named"),
    [
        ({"bodies": ()}, ConfigError, "bodies"),
        ({"bodies": ("a", "")}, ConfigError, "base and bodies"),
        ({"bodies": ("a", "a")}, ConfigError, "base and bodies"),
        ({"bodies": ("base",)}, ConfigError, "base and bodies"),
        ({"up": "x"}, ConfigError, "up"),
        ({"interface": "0.0.0.0"}, ConfigError, "interface"),
        ({"server": "motive.local"}, ConfigError, "server"),
        ({"server": "239.255.42.99"}, ConfigError, "server"),
        ({"group": "10.0.0.1"}, ConfigError, "group"),
        ({"base_offset": (0.0, 0.0)}, ConfigError, "base_offset"),
        ({"base_offset": (0.0, 0.0, math.nan)}, ValueRangeError, "base_offset"),
        ({"base_quaternion": (0.0, 0.0, 0.0, 0.0)}, ValueRangeError, "base_quaternion"),
        ({"scale": 0.0}, ValueRangeError, "scale"),
        ({"scale": math.inf}, ValueRangeError, "scale"),
        ({"max_speed": -1.0}, ValueRangeError, "max_speed"),
        ({"max_drift": -1e-6}, ValueRangeError, "max_drift"),
        ({"recovery_frames": 1}, ValueRangeError, "recovery_frames"),
        ({"base_frames": 0}, ValueRangeError, "base_frames"),
        ({"command_port": 0}, ValueRangeError, "command_port"),
        ({"data_port": 70000}, ValueRangeError, "data_port"),
        ({"timeout": 0.05}, ValueRangeError, "timeout"),
    ],
)
def test_bad_settings_are_named(changes: dict[str, object], error: type[ApccError], named: str) -> None:
    with pytest.raises(error, match=f"^{named} must"):
        settings(**changes)
