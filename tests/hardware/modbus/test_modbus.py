"""The driver of regulators against pymodbus's own server: what it reads, writes, refuses and leaves behind."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from apcc_torch.errors import (
    ApccError,
    CommunicationError,
    DataError,
    DeviceFaultError,
    HardwareError,
    SafetyError,
    ValueRangeError,
)
from apcc_torch.hardware.modbus.actuator import ModbusRegulators
from apcc_torch.hardware.modbus.link import spans
from apcc_torch.hardware.modbus.settings import RegulatorSettings
from hardware.emulators.regulator.emulator import RegulatorEmulator


@pytest.fixture(scope="module")
def server() -> Iterator[RegulatorEmulator]:
    with RegulatorEmulator({1: 3, 2: 3}) as server:
        yield server


@pytest.fixture
def regulators(server: RegulatorEmulator) -> Iterator[RegulatorEmulator]:
    server.do("fresh")
    yield server
    server.do("fresh")


def driver(server: RegulatorEmulator, **changes: object) -> ModbusRegulators:
    return ModbusRegulators(RegulatorSettings(**server.settings(**changes)))


def test_pressures_go_out_in_counts_and_come_back(regulators: RegulatorEmulator) -> None:
    with driver(regulators) as actuator:
        assert actuator.sets_pressure and actuator.n_tendons == 6 and actuator.read().y.max() == 0.0
        actuator.arm()
        told = regulators.do("report")
        assert [told[unit]["enabled"] for unit in (1, 2)] == [1, 1] and told[1]["watchdog"] == 30_000
        wish = np.array([12_344.0, 20_000.0, 5e5, -3e4, 41_006.0, 0.0])
        sent = actuator.send(wish)
        assert sent.tolist() == [12_340.0, 20_000.0, 120_000.0, 0.0, 41_010.0, 0.0], "whole counts within the limits"
        time.sleep(0.6)
        reading = actuator.read()
        assert reading.y == pytest.approx(sent, abs=15.0) and (reading.effort == 0.0).all()
        assert reading.raw["pressure"] == [round(p / 10.0) for p in reading.y]
        told = regulators.do("report")
        assert told[1]["command"] == [1234, 2000, 12_000] and told[2]["command"] == [0, 4101, 0]
        assert told[1]["beat"] == told[2]["beat"] == 2
        actuator.hold()
        assert regulators.do("report")[1]["command"] == pytest.approx([1234, 2000, 12_000], abs=2)
    told = regulators.do("report")
    assert [told[unit]["command"] for unit in (1, 2)] == [[0, 0, 0]] * 2, "on every exit the chambers are vented"
    assert [told[unit]["enabled"] for unit in (1, 2)] == [0, 0]


def test_nothing_is_commanded_before_it_is_armed(regulators: RegulatorEmulator) -> None:
    with driver(regulators) as actuator:
        with pytest.raises(HardwareError, match="sending needs the regulators armed"):
            actuator.send(np.zeros(6))
        with pytest.raises(HardwareError, match="connected already"):
            actuator.connect()
        actuator.torque_off()
        assert regulators.do("report")[1]["sent"] == []
        actuator.arm()
        for wrong in (np.full(6, np.nan), np.zeros(5)):
            with pytest.raises(ApccError, match="pressures must"):
                actuator.send(wrong)
    with pytest.raises(HardwareError, match="connect before"):
        driver(regulators).read()


def test_rounding_stays_within_what_may_be_sent(regulators: RegulatorEmulator) -> None:
    actuator = driver(regulators, command_scale=[7.0, 10.0, 13.0, 7.0, 10.0, 13.0])
    last = actuator.rounded(np.linspace(0.0, 1.2e5, 6), np.zeros(6), np.full(6, 1.2e5))
    for reach in (0.0, 20.0, 333.3):
        low, high = np.maximum(last - reach, 0.0), np.minimum(last + reach, 1.2e5)
        y = actuator.rounded(np.full(6, 6e4), low, high)
        assert (y >= low - 1e-6).all() and (y <= high + 1e-6).all()


def test_a_calibration_tells_the_registers(regulators: RegulatorEmulator) -> None:
    with driver(regulators) as actuator:
        zero = actuator.calibrate()
        actuator.restore(zero)
        with pytest.raises(DataError, match="commands"):
            actuator.restore({**zero, "commands": [9] * 6})


@pytest.mark.parametrize(
    ("order", "error", "said"),
    [
        ({"unit": 2, "kind": 5}, HardwareError, "unit 2 at .* is of kind 5, not 77"),
        ({"unit": 1, "status": 8}, DeviceFaultError, "unit 1 at .* status bits 0x0008"),
        ({"unit": 2, "refuse": 9}, CommunicationError, "unit 2 at .* refuses reading input registers"),
    ],
)
def test_what_is_wrong_from_the_start_is_refused(
    regulators: RegulatorEmulator, order: dict[str, int], error: type[HardwareError], said: str
) -> None:
    regulators.do("set", order["unit"], **{name: value for name, value in order.items() if name != "unit"})
    actuator = driver(regulators)
    with pytest.raises(error, match=said):
        actuator.connect()
    actuator.disconnect()
    assert all(told["sent"] == [] for told in regulators.do("report").values())


def test_a_chamber_under_too_much_pressure_is_not_armed(regulators: RegulatorEmulator) -> None:
    regulators.do("set", 1, offset=13_000)
    with driver(regulators) as actuator:
        with pytest.raises(SafetyError, match=r"chamber 1 is at 130\.0 kPa, outside 0 to 120 kPa"):
            actuator.arm()
        assert regulators.do("report")[1]["sent"] == []


def test_a_unit_that_says_nothing_is_named_and_the_others_are_vented(regulators: RegulatorEmulator) -> None:
    actuator = driver(regulators, reply_timeout=0.3)
    actuator.connect()
    actuator.arm()
    actuator.send(np.full(6, 3e4))
    regulators.do("set", 2, mute=100)
    for use in (actuator.read, actuator.hold, lambda: actuator.send(np.full(6, 2e4))):
        with pytest.raises(CommunicationError, match=r"unit 2 at .*no reply"):
            use()
    with pytest.raises(CommunicationError, match="venting is not confirmed by unit 2"):
        actuator.torque_off()
    actuator.disconnect()
    told = regulators.do("report")
    assert told[1]["enabled"] == 0 and told[1]["command"] == [0, 0, 0] and told[2]["enabled"] == 1


def test_one_lost_reply_is_overcome_and_no_late_one_is_taken_for_another(regulators: RegulatorEmulator) -> None:
    with driver(regulators, reply_timeout=0.5) as actuator:
        actuator.arm()
        regulators.do("set", 1, mute=1)
        with pytest.raises(CommunicationError, match="unit 1"):
            actuator.read()
        actuator.send(np.full(6, 1e4))
        time.sleep(0.4)
        assert actuator.read().y == pytest.approx(1e4, abs=30.0)


def test_units_vent_by_their_own_watchdog(regulators: RegulatorEmulator) -> None:
    with driver(regulators, watchdog=0.3) as actuator:
        actuator.arm()
        actuator.send(np.full(6, 5e4))
        time.sleep(1.0)  # nobody asks
        with pytest.raises(DeviceFaultError, match="status bits 0x0002"):
            actuator.read()
        assert max(regulators.do("report")[1]["pressure"]) < 100


def test_no_server_is_one_sentence() -> None:
    with RegulatorEmulator({1: 2}) as server:
        settings = RegulatorSettings(**server.settings(reply_timeout=0.5))
    with pytest.raises(CommunicationError, match=rf"no Modbus server answers at 127\.0\.0\.1:{server.port}"):
        ModbusRegulators(settings).connect()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"readings": (0,)}, "readings must have 6 entries"),
        ({"units": (1, 2)}, "units must have one entry, or 6"),
        ({"units": (1,)}, "commands must be another register for every chamber"),
        ({"upper": 1e6, "command_scale": 1.0}, "must fit a register of 16 bits"),
        ({"lower": 2e5}, "lower must be below upper"),
        ({"watchdog": 1e-4}, "watchdog must be from 1 to"),
    ],
)
def test_settings_without_meaning_are_refused(changes: dict[str, object], said: str) -> None:
    with pytest.raises(ApccError, match=said):
        RegulatorSettings(**RegulatorEmulator({1: 3, 2: 3}).settings(**changes))


def test_spans_hold_every_register_in_requests_that_the_protocol_allows() -> None:
    assert spans([3, 1, 2]) == [(1, 4)] and spans([1, 3], gap=0) == [(1, 2), (3, 4)]
    wide = spans(list(range(0, 500, 5)))
    assert all(end - begin <= 100 for begin, end in wide)
    assert all(any(begin <= place < end for begin, end in wide) for place in range(0, 500, 5))


def test_a_thousand_exchanges_without_a_failure(regulators: RegulatorEmulator) -> None:
    """A short form of benchmarks/regulators.py, without its clock."""
    with driver(regulators) as actuator:
        actuator.arm()
        for k in range(500):
            assert actuator.read().y.shape == (6,)
            actuator.send(1e4 + 5e3 * np.sin(0.1 * k + np.arange(6)))
    told = regulators.do("report")
    assert len(told[1]["sent"]) == len(told[2]["sent"]) == 502, "arming, five hundred commands, venting"
    with pytest.raises(ValueRangeError):
        RegulatorSettings(**regulators.settings(port=0))
