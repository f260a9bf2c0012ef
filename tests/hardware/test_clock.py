"""The two clocks, and signals as wishes."""

from __future__ import annotations

import os
import signal
import time

from apcc_torch.hardware.clock import MonotonicClock, VirtualClock
from apcc_torch.hardware.stop_request import StopRequest
from apcc_torch.hardware.stops import StopReason


def test_the_monotonic_clock_is_never_early_and_does_not_wait_for_the_past() -> None:
    clock = MonotonicClock()
    begin = clock.now()
    for k in range(1, 6):
        clock.wait_until(begin + 0.004 * k)
        assert time.monotonic() >= begin + 0.004 * k
    before = time.perf_counter()
    clock.wait_until(begin)
    assert time.perf_counter() - before < 0.05


def test_the_virtual_clock_jumps_and_takes_its_followers_along() -> None:
    clock = VirtualClock(2.0)
    seen: list[float] = []
    clock.followers.append(seen.append)
    clock.wait_until(1.0)
    clock.wait_until(2.5)
    assert clock.now() == 2.5 and seen == [2.5]


def test_signals_become_requests_and_their_handlers_come_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    request = StopRequest()
    with request.on_signals():
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        end = time.monotonic() + 5.0
        while request.count < 2 and time.monotonic() < end:
            time.sleep(0.001)
    assert signal.getsignal(signal.SIGTERM) is before
    assert request.count == 2 and request.stop is not None
    assert request.stop.reason in (StopReason.TERMINATED, StopReason.INTERRUPTED)
