"""Signs and widths over the whole range, against struct."""

from __future__ import annotations

import struct
from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import CommunicationError, ValueRangeError
from apcc_torch.hardware.dynamixel import registers
from apcc_torch.hardware.dynamixel.models import model_of
from apcc_torch.hardware.dynamixel.registers import hardware_errors
from apcc_torch.hardware.servos.register import Register
from apcc_torch.hardware.servos.spool import TICK

ALL = sorted(value for value in vars(registers).values() if isinstance(value, Register))
CODES = {(1, False): "<B", (2, False): "<H", (4, False): "<I", (1, True): "<b", (2, True): "<h", (4, True): "<i"}


@given(register=st.sampled_from(ALL), data=st.binary(min_size=4, max_size=4))
def test_every_bit_pattern_is_the_number_it_stands_for(register: Register, data: bytes) -> None:
    data = data[: register.length]
    (expected,) = struct.unpack(CODES[register.length, register.signed], data)
    assert register.decode(data) == expected
    assert register.encode(expected) == data


@pytest.mark.parametrize("register", ALL, ids=lambda register: register.name)
def test_ends_of_the_range(register: Register) -> None:
    bits = 8 * register.length
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if register.signed else (0, 2**bits - 1)
    assert register.decode(register.encode(low)) == low and register.decode(register.encode(high)) == high
    for value in (low - 1, high + 1):
        with pytest.raises(ValueRangeError, match=register.name):
            register.encode(value)
    with pytest.raises(CommunicationError, match=f"{register.name} has {register.length} bytes, got 0"):
        register.decode(b"")


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        (registers.VELOCITY_UNIT, 0.229 / 60 * 2 * pi),  # rev/min
        (registers.ACCELERATION_UNIT, 214.577 / 60**2 * 2 * pi),  # rev/min^2
        (TICK, 2 * pi / 4096),
        (model_of(1030).current_unit, 3.21 / 1193),  # the whole range is 3.21 A
    ],
)
def test_units_are_the_makers(unit: float, expected: float) -> None:
    assert unit == pytest.approx(expected, rel=1e-3)


def test_hardware_error_names() -> None:
    assert hardware_errors(0) == ""
    assert hardware_errors(0b10_0000) == "overload"
    assert hardware_errors(0b100_0101) == "input voltage, overheating, bit 6"
