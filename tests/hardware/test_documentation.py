"""docs/hardware.md against the program: the table of stops, and the keys it names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import apcc_torch
from apcc_torch.hardware.stops import Ending, StopReason
from apcc_torch.reading import plain
from composed import composed_realtime
from hardware.faults import Fault, Left, full_disk, stopped

PAGE = (Path(apcc_torch.__file__).resolve().parents[1] / "docs" / "hardware.md").read_text()
DONE = {Ending.HOLD: "held", Ending.TORQUE_OFF: "let go"}


def test_the_table_of_stops_is_the_programs() -> None:
    rows = re.findall(r"^\| (\d+) \| `(\w+)` \| ([a-z ]+) \| (.+) \|$", PAGE, re.MULTILINE)
    assert rows == [(str(r.code), r.value, DONE[r.ending], r.meaning) for r in StopReason]


def test_the_table_of_faults_is_that_of_the_tests() -> None:
    left = {Left.HELD: "held", Left.LET_GO: "let go", Left.UNTOUCHED: "left as it was"}
    rows = re.findall(r"^\| ([a-zA-Z ]+) \| `(\w+)` \| (\d+) \| ([a-z ]+).* \|$", PAGE, re.MULTILINE)
    expected = [*Fault.every(), full_disk(), stopped()]
    assert rows == [(fault.name, fault.reason.value, str(fault.reason.code), left[fault.left]) for fault in expected]


def test_every_key_it_names_exists() -> None:
    platforms = ("dynamixel_optitrack", "dynamixel_qualisys", "feetech_optitrack")
    chosen = [plain(composed_realtime("experiment=setpoint", f"hardware={name}")) for name in platforms]
    keys = set(re.findall(r"`((?:hardware|guards|loop|calibration|robot)(?:\.[a-z_]+)+)", PAGE))
    keys |= set(re.findall(r" ((?:hardware|guards|loop|calibration|controller|experiment)(?:\.[A-Za-z_]+)+)=", PAGE))
    assert len(keys) > 20
    for key in keys:
        assert any(holds(settings, key.split(".")) for settings in chosen), f"{key} is no key"


def holds(values: Any, names: list[str]) -> bool:
    """Whether nested values have an entry of these names."""
    for name in names:
        if not isinstance(values, dict) or name not in values:
            return False
        values = values[name]
    return True
