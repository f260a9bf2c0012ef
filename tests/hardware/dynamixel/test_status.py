"""The status block: its bytes, and what shows in it."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.dynamixel.status import STATUS_LENGTH, MotorStatus, indirect_addresses

SOUND = MotorStatus(5, -6, 7, 1, 0, 5, 2)


@given(data=st.binary(min_size=14, max_size=14))
def test_decoding(data: bytes) -> None:
    assert MotorStatus.decode(data) == struct.unpack("<hiiBBbB", data)


@pytest.mark.parametrize("length", [0, 13])
def test_too_few_bytes(length: int) -> None:
    with pytest.raises(CommunicationError, match="bytes"):
        MotorStatus.decode(bytes(length))


def test_indirect_addresses_are_legal_and_in_order() -> None:
    addresses = struct.unpack("<14H", indirect_addresses())
    assert len(addresses) == STATUS_LENGTH
    assert addresses == (*range(126, 136), 64, 70, 98, 68)


@pytest.mark.parametrize(
    ("change", "armed", "said"),
    [
        ({}, True, ""),
        ({"torque": 0}, False, ""),
        ({"watchdog": -1}, False, ""),
        ({"watchdog": -1}, True, "watchdog tripped"),
        ({"watchdog": 0}, True, "bus watchdog 0 instead of 5"),
        ({"torque": 0}, True, "lost its torque"),
        ({"hardware_error": 32}, False, "reports overload"),
        ({"hardware_error": 32, "torque": 0}, True, "reports overload, and has let go"),
        ({"return_level": 0, "torque": 0}, False, "restarted"),
    ],
)
def test_faults(change: dict[str, int], armed: bool, said: str) -> None:
    fault = SOUND._replace(**change).fault(armed, 5)
    assert said in fault and bool(fault) == bool(said)
