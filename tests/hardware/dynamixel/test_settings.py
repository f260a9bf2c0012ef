"""Settings that have no meaning are refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from apcc_torch.errors import ApccError
from apcc_torch.hardware.dynamixel.settings import GripperSettings
from hardware.dynamixel.rig import GRIPPER, SIGNS, TENDONS, settings

PORT = Path("/dev/ttyUSB0")


def test_a_number_serves_every_tendon() -> None:
    made = settings(PORT, spool_radii=0.02, upper=0.01)
    assert made.each("spool_radii") == [0.02] * 9 and made.each("upper") == [0.01] * 9
    assert made.each("signs") == list(SIGNS)


def test_lists_become_tuples_and_the_watchdog_is_rounded_up() -> None:
    made = settings(PORT, ids=list(TENDONS), bus_watchdog=0.101)
    assert made.ids == TENDONS
    assert made.watchdog_ticks == 6
    assert settings(PORT, bus_watchdog=0.1).watchdog_ticks == 5
    assert settings(PORT, bus_watchdog=0.001).watchdog_ticks == 1
    assert settings(PORT, bus_watchdog=2.54).watchdog_ticks == 127


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("ids", (1,) * 9),
        ("ids", (*TENDONS[:8], GRIPPER)),
        ("ids", (*TENDONS[:8], 253)),
        ("ids", (*TENDONS[:8], 1.5)),
        ("spool_radii", (0.01,) * 8),
        ("spool_radii", (0.0,) * 9),
        ("spool_radii", (float("nan"),) * 9),
        ("signs", (0,) * 9),
        ("lower", (0.001,) * 9),
        ("lower", (float("-inf"),) * 9),
        ("upper", (-0.001,) * 9),
        ("mode", "position"),
        ("baud", 0),
        ("current_limit", 0.0),
        ("current_limit", 3.3),
        ("profile_velocity", 0.0),  # no limit at all, to the motor
        ("profile_velocity", 1e-3),  # rounded, the same
        ("profile_velocity", 25.0),  # more than the motors' limit can be
        ("profile_acceleration", 0.0),
        ("position_gains", (800, 0)),
        ("position_gains", (800, 0, 0.5)),
        ("position_gains", (800, 0, -1)),
        ("bus_watchdog", 0.0),  # off
        ("bus_watchdog", 2.55),
        ("reply_timeout", 0.0),
        ("torque_constant", -1.3),
        ("zero_tolerance", 0.0),
    ],
)
def test_refused(key: str, value: Any) -> None:
    with pytest.raises(ApccError, match=f"^{key} must"):
        settings(PORT, **{key: value})


def test_no_tendons() -> None:
    empty = {"ids": ()}
    with pytest.raises(ApccError, match=r"^ids must"):
        settings(PORT, **empty)


@pytest.mark.parametrize(
    ("key", "value"),
    [("id", -1), ("open_angle", 7.0), ("closed_angle", float("nan")), ("open_angle", 2.0), ("current_limit", 9.0)],
)
def test_gripper_refused(key: str, value: Any) -> None:
    good: dict[str, Any] = {"id": 10, "open_angle": 1.0, "closed_angle": 2.0}
    with pytest.raises(ApccError, match=f"^{key} must"):
        GripperSettings(**good | {key: value})
