"""The models' data against the tables that the maker's SDK brings along, and the physics in them."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.hardware.dynamixel import registers
from apcc_torch.hardware.dynamixel.models import Model, model_of, models
from apcc_torch.hardware.dynamixel.settings import DynamixelSettings, GripperSettings
from apcc_torch.hardware.servos.register import Register
from hardware.dynamixel.rig import TENDONS, settings

PORT = Path("/dev/ttyUSB0")
EVERY = [pytest.param(model, id=model.name) for model in models().values()]
USED = [value for value in vars(registers).values() if isinstance(value, Register)]
CURRENTS = {registers.CURRENT_LIMIT, registers.GOAL_CURRENT, registers.PRESENT_CURRENT}


def sdk_tables() -> Path:
    spec = find_spec("dynamixel_easy_sdk")
    if spec is None or spec.origin is None:
        pytest.skip("this SDK brings no control tables along")
    return Path(spec.origin).parent / "control_table"


def sdk_table(model: Model) -> dict[str, tuple[int, int]]:
    """Name -> address and length, of the newest firmware that the SDK knows."""
    folder = sdk_tables()
    names = dict(line.split("\t") for line in (folder / "dynamixel.model").read_text().splitlines()[1:] if line)
    file = folder / names[str(model.number)].strip()
    newest = file.with_name(f"{file.stem}_fw52.model")
    rows = (newest if newest.exists() else file).read_text().partition("[control table]")[2].splitlines()
    table = {}
    for row in rows[2:]:
        if row.strip():
            address, size, name = row.split("\t")
            table.setdefault(name.strip().lower(), (int(address), int(size)))
    return table


@pytest.mark.parametrize("model", EVERY)
def test_the_number_is_the_sdks(model: Model) -> None:
    names = dict(line.split("\t") for line in (sdk_tables() / "dynamixel.model").read_text().splitlines()[1:] if line)
    assert names[str(model.number)].strip() == f"{model.name.lower().replace('-', '_')}.model"


@pytest.mark.parametrize("model", EVERY)
def test_every_register_is_where_the_sdk_has_it(model: Model) -> None:
    """Also that a model without current control has no register of it."""
    table = sdk_table(model)
    known = 0
    for register in USED:
        name = {"secondary id": "secondary(shadow) id"}.get(register.name, register.name.lower())
        if model.current_unit is None and register in CURRENTS:
            assert name not in table
            name = "present load" if register is registers.PRESENT_CURRENT else name
        if name in table:
            known += 1
            assert table[name] == (register.address, register.length), register.name
    assert known >= len(USED) - 4
    assert table["indirect address 1"] == (registers.INDIRECT_ADDRESS, 2)
    assert table["indirect data 1"] == (model.indirect_data, 1)


@pytest.mark.parametrize("model", EVERY)
def test_a_stalled_motor_draws_what_it_may(model: Model) -> None:
    """Ohm's law: at the share of the voltage that it is left, the current is not above the limit, and close to it."""
    for supply in (0.9 * model.voltage, model.voltage, 1.2 * model.voltage):
        for limit in (0.1 * model.stall_current, 0.5 * model.stall_current):
            pwm = model.stalled_pwm(limit, supply)
            ohms = model.voltage / model.stall_current
            drawn = pwm / 885 * supply / ohms
            assert limit - 0.01 * model.stall_current <= drawn <= limit * (1 + 1e-9)
    assert model.stalled_pwm(100.0, model.voltage) == 885
    assert model.largest_current <= 1.25 * model.stall_current * 14.8 / 12 or model.voltage != 12


def test_an_unknown_model_is_refused_in_one_sentence() -> None:
    with pytest.raises(ConfigError, match=r"^model_number must be one of 1000 \(XH430-W350\), .*, got 1234$"):
        model_of(1234)
    with pytest.raises(ConfigError, match=r"^model_number must be one of"):
        settings(PORT, model_number=(1030,) * 8 + (350,))
    with pytest.raises(ConfigError, match=r"^model_number must have 9 entries, got 8"):
        settings(PORT, model_number=(1030,) * 8)


def test_limits_are_the_models() -> None:
    mixed = (1030,) * 8 + (1220,)
    with pytest.raises(ValueRangeError, match=r"^current_limit must be at most 0\.91 A for XC330-T288, got 1\.0"):
        settings(PORT, model_number=mixed)
    assert settings(PORT, model_number=mixed, current_limit=(1.0,) * 8 + (0.5,)).currents[TENDONS[8]] == 0.5
    with pytest.raises(ValueRangeError, match=r"^current_limit must be at most 1\.4 A for XL430-W250, got 1\.5"):
        settings(PORT, model_number=1060, current_limit=1.5)
    # The 430s turn 24.5 rad/s at most, the 330s twice that.
    with pytest.raises(ValueRangeError, match=r"^profile_velocity must be at most .* for XM430-W210"):
        settings(PORT, model_number=1200, profile_velocity=30.0)
    alone = settings(PORT, model_number=1200, profile_velocity=30.0, gripper=None)
    assert isinstance(alone, DynamixelSettings)
    with pytest.raises(ValueRangeError, match=r"^current_limit must be at most 1\.75 A for XL330-M288, got 2\.0"):
        GripperSettings(id=3, model_number=1200, current_limit=2.0)


def test_modes_are_those_that_a_model_has() -> None:
    mixed = settings(PORT, model_number=(1030,) * 8 + (1060,))
    last = TENDONS[8]
    assert mixed.mode_of(TENDONS[0]) == "current_based_position" and not mixed.limited_by_voltage(TENDONS[0])
    assert mixed.mode_of(last) == "extended_position" and mixed.limited_by_voltage(last)
    free = settings(PORT, model_number=(1030,) * 8 + (1060,), mode="extended_position")
    assert not any(free.limited_by_voltage(motor) for motor in free.every_id)
    moved = settings(PORT, mode="velocity", velocity_gain=0.5)
    assert moved.mode_of(last) == "velocity" and moved.limited_by_voltage(last)
    assert moved.mode_of(30) == "current_based_position"  # the gripper's


def test_a_velocity_gain_that_could_pass_the_goal_is_refused() -> None:
    with pytest.raises(ValueRangeError, match=r"^velocity_gain must be at most 10 1/s with a bus_watchdog of 0\.1 s"):
        settings(PORT, mode="velocity", bus_watchdog=0.09, velocity_gain=10.5)
    with pytest.raises(ValueRangeError, match=r"^velocity_gain must be at most profile_acc"):
        settings(PORT, mode="velocity", bus_watchdog=0.1, profile_acceleration=20.0)
    assert settings(PORT, mode="velocity", bus_watchdog=0.1, velocity_gain=10.0).velocity_gain == 10.0
