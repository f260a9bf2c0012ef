"""The port's clock and timeouts, and a line that never falls silent."""

from __future__ import annotations

import time

import pytest

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.servos.port import BusPort


class Babble:
    """A serial line with bytes on it, always."""

    in_waiting = 5

    def read(self, length: int) -> bytes:
        return bytes(length)


def test_the_timeout_is_the_line_and_the_settings() -> None:
    port = BusPort("/dev/null", 1_000_000, 0.01)
    port.tx_time_per_byte = 0.01  # ms: ten bits at 1 Mbit/s
    port.setPacketTimeout(250)
    assert port.packet_timeout == pytest.approx(2.5 + 10.0)


def test_the_clock_is_monotonic(monkeypatch: pytest.MonkeyPatch) -> None:
    port = BusPort("/dev/null", 1_000_000, 0.01)
    before = port.getCurrentTime()
    monkeypatch.setattr(time, "time", lambda: 0.0)
    assert port.getCurrentTime() >= before


def test_what_lies_unread_is_not_overdue() -> None:
    port = BusPort("/dev/null", 1_000_000, 0.01)
    port.ser = Babble()
    port.setPacketTimeout(10)
    port.packet_start_time -= 1000.0  # the program was held up
    assert not port.isPacketTimeout()
    assert any(port.isPacketTimeout() for _ in range(50))  # but not for ever


def test_a_line_that_never_falls_silent() -> None:
    port = BusPort("/dev/null", 1_000_000, 0.01)
    port.ser = Babble()
    with pytest.raises(CommunicationError, match="never falls silent"):
        port.clearPort()


def test_a_closed_port() -> None:
    port = BusPort("/dev/null", 1_000_000, 0.01)
    for use in (lambda: port.readPort(1), lambda: port.writePort([1]), port.getBytesAvailable):
        with pytest.raises(CommunicationError, match="is not open"):
            use()
    port.closePort()
