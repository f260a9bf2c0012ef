"""The clock map against simulated clocks whose true difference is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.hardware.mocap.clock import ClockMap

MIN_DELAY = 2e-4


def clock_map(max_drift: float = 1e-4) -> ClockMap:
    return ClockMap(max_drift, step=0.1, confirm=5)


def errors(clock: ClockMap, seconds: float, drift: float, ahead: float, delays: np.ndarray, rate: float) -> np.ndarray:
    """Stamp minus true time of each packet, for a server's clock that reads `ahead + (1 + drift) t`."""
    found = []
    for i, delay in zip(range(int(seconds * rate)), delays, strict=False):
        t = i / rate
        sent, arrival = ahead + (1.0 + drift) * t, t + delay
        clock.update(sent, arrival)
        found.append(clock.stamp(sent - 0.004, arrival) - (t - 0.004))
    return np.array(found)


@given(
    drift=st.floats(-5e-5, 5e-5),
    ahead=st.floats(-1e5, 1e5),
    jitter=st.floats(1e-5, 3e-3),
    rate=st.sampled_from([50.0, 120.0, 240.0]),
    seed=st.integers(0, 2**31),
)
def test_stamps_follow_the_true_time_under_drift_and_jitter(
    drift: float, ahead: float, jitter: float, rate: float, seed: int
) -> None:
    delays = MIN_DELAY + np.random.default_rng(seed).exponential(jitter, int(60 * rate))
    found = errors(clock_map(), 60.0, drift, ahead, delays, rate)
    # Never before the truth by more than the exposure's few ms times the drift; late by no more than what the fastest
    # packets of some seconds were delayed.
    assert found.min() > -1e-6
    assert found[int(5 * rate) :].max() < MIN_DELAY + jitter + 4e-4


def test_drift_of_an_hour_is_followed_to_a_fraction_of_a_millisecond() -> None:
    delays = MIN_DELAY + np.random.default_rng(3).exponential(2e-4, 180_000)
    for drift in (-5e-5, 5e-5):  # 180 ms within the hour
        found = errors(clock_map(), 3600.0, drift, 1e4, delays, 50.0)
        assert np.abs(found[100:]).max() < 6e-4


def test_a_queue_that_delays_every_packet_does_not_move_the_clock() -> None:
    delays = np.full(3000, MIN_DELAY)
    delays[1000:2000] += 0.3  # twenty seconds of packets that come 0.3 s late
    found = errors(clock_map(), 60.0, 0.0, 0.0, delays, 50.0)
    assert np.abs(found[:1000] - MIN_DELAY).max() < 1e-5
    assert found[1000:2000].max() < MIN_DELAY + 20.4 * 1e-4
    assert np.abs(found[2000:] - MIN_DELAY).max() < 1e-5


@pytest.mark.parametrize("step", [7.0, -7.0])
def test_a_clock_that_was_set_is_followed_after_some_packets_that_agree(step: float) -> None:
    clock = clock_map()
    before = errors(clock, 2.0, 0.0, 0.0, np.full(100, MIN_DELAY), 50.0)
    assert np.abs(before - MIN_DELAY).max() < 1e-5 and clock.steps == 0
    stamps = []
    for i in range(100, 120):
        t = i / 50.0
        clock.update(t + step, t + MIN_DELAY)
        stamps.append(clock.stamp(t + step, t + MIN_DELAY) - t)
    assert clock.steps == 1
    # In between a stamp says too old, or the arrival: never later than that.
    assert max(stamps) <= MIN_DELAY + 1e-9
    np.testing.assert_allclose(stamps[4:], MIN_DELAY, atol=1e-6)


@pytest.mark.parametrize("wrong", [1e9, -1e9, 0.5, -0.5])
def test_one_wrong_stamp_changes_nothing(wrong: float) -> None:
    clock = clock_map()
    errors(clock, 2.0, 0.0, 0.0, np.full(100, MIN_DELAY), 50.0)
    offset = clock.offset
    clock.update(2.0 + wrong, 2.0 + MIN_DELAY)
    assert clock.offset == offset and clock.steps == 0
    assert clock.stamp(2.0 + wrong, 2.0 + MIN_DELAY) <= 2.0 + MIN_DELAY
    clock.update(2.02, 2.02 + MIN_DELAY)
    assert clock.offset == pytest.approx(MIN_DELAY, abs=1e-5)


def test_before_the_first_packet_and_after_a_reset_only_the_arrival_is_known() -> None:
    clock = clock_map()
    assert clock.stamp(5.0, 3.0) == 3.0
    clock.update(5.0, 3.0)
    assert clock.stamp(4.5, 3.0) == 2.5
    clock.reset()
    assert clock.stamp(4.5, 3.0) == 3.0
