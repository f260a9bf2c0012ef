"""Faults of the stream, injected by the server of another process: what a sample says, what is counted, what ends."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator

import numpy as np
import pytest

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.mocap.gate import Reason
from apcc_torch.hardware.optitrack.sensor import OptiTrackSensor
from hardware.emulators.mocap_server import standing
from hardware.emulators.natnet_server import NatNetServer
from hardware.optitrack.served import RATE, all_valid, connected, eventually, next_sample, renew, sample_beyond
from hardware.optitrack.test_tracker import expected

REST = expected(standing(4))


@pytest.fixture(scope="module")
def running() -> Iterator[NatNetServer]:
    with NatNetServer(rate=RATE) as server:
        yield server


@pytest.fixture
def server(running: NatNetServer) -> NatNetServer:
    renew(running)
    return running


@pytest.fixture
def sensor(server: NatNetServer) -> Iterator[OptiTrackSensor]:
    with connected(server) as sensor:
        assert eventually(lambda: all_valid(sensor))
        yield sensor


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"untracked": [3]}, Reason.UNTRACKED),
        ({"missing": [3]}, Reason.MISSING),
        ({"nan": [3]}, Reason.NON_FINITE),
        ({"zero_quaternion": [3]}, Reason.BAD_QUATERNION),
        ({"stretch": {3: 1.05}}, Reason.BAD_QUATERNION),
    ],
)
def test_a_bad_body_is_not_valid_and_comes_back(
    server: NatNetServer, sensor: OptiTrackSensor, fault: dict[str, object], reason: Reason
) -> None:
    changed = server.fault(**fault)
    sample = sample_beyond(sensor, changed)
    assert sample.reasons == (Reason.OK, reason, Reason.OK) and sample.valid.tolist() == [True, False, True]
    assert np.isnan(sample.T[1]).all() and np.isfinite(sample.T[[0, 2]]).all()
    assert sensor.counts().bodies["disk_2"][reason.name.lower()] >= 1
    assert sample_beyond(sensor, server.fault()).reasons == (Reason.OK,) * 3


def test_a_body_with_the_very_same_numbers_is_frozen(server: NatNetServer, sensor: OptiTrackSensor) -> None:
    began = server.fault(frozen=[3])
    limit = sensor.settings.frozen_frames
    seen = {began: Reason.OK}
    while max(seen) < began + limit + 5:
        sample = next_sample(sensor)
        seen[sample.sequence] = sample.reasons[1]
    for sequence, reason in seen.items():  # the last pose before was the first of those that are the same
        assert reason is (Reason.OK if sequence < began + limit - 1 else Reason.FROZEN)
    assert sample_beyond(sensor, server.fault()).reasons == (Reason.OK,) * 3


def test_a_jump_is_held_back_until_it_is_consistent(server: NatNetServer, sensor: OptiTrackSensor) -> None:
    changed = server.fault(jump={3: (0.3, 0.0, 0.0)})
    after = sample_beyond(sensor, changed + sensor.settings.recovery_frames)
    assert after.reasons == (Reason.OK,) * 3
    assert after.T[1, 0, 3] == pytest.approx(REST[1, 0, 3] + 0.3, abs=1e-3)
    counted = sensor.counts().bodies["disk_2"]
    assert counted["jump"] == 1 and counted["recovering"] == sensor.settings.recovery_frames - 2


def test_swapped_names_are_not_valid_for_as_long_as_it_lasts(server: NatNetServer, sensor: OptiTrackSensor) -> None:
    changed = server.fault(swap=(2, 4))
    for more in range(60):
        sample = sample_beyond(sensor, changed + more)
        assert sample.reasons == (Reason.SWAPPED, Reason.OK, Reason.SWAPPED)
        assert sample.valid.tolist() == [False, True, False]
    sample = sample_beyond(sensor, server.fault() + sensor.settings.recovery_frames)
    assert sample.reasons == (Reason.OK,) * 3
    np.testing.assert_allclose(sample.T, REST, atol=2e-4)


def test_a_frame_number_that_stands_still_ends_the_source(server: NatNetServer, sensor: OptiTrackSensor) -> None:
    server.fault(frozen_number=True)
    assert eventually(lambda: sensor.counts().repeated > 5)
    frozen = sensor.latest()
    assert frozen is not None and sensor.wait(0.05, after=frozen.sequence) is None
    assert eventually(lambda: "the frame number stays at" in _error(sensor))
    server.fault()
    assert eventually(lambda: all_valid(sensor))


def _error(sensor: OptiTrackSensor) -> str:
    try:
        sensor.latest()
    except CommunicationError as error:
        return str(error)
    return ""


def test_late_frames_are_not_valid(server: NatNetServer, sensor: OptiTrackSensor) -> None:
    assert next_sample(sensor).valid.all()
    server.fault(delay=0.7)
    assert eventually(lambda: sensor.counts().late > 3)
    sample = next_sample(sensor)
    assert sample.reasons == (Reason.LATE,) * 3 and time.monotonic() - sample.stamp > 0.6
    server.fault()
    assert eventually(lambda: bool(next_sample(sensor).valid.all()))


@pytest.mark.parametrize("left", [0, 3, 10, 60, 200])
def test_truncated_datagrams_are_counted_and_end_the_source(
    server: NatNetServer, sensor: OptiTrackSensor, left: int, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        server.fault(truncate=left)
        assert eventually(lambda: sensor.counts().malformed > 10)
        assert eventually(lambda: "of them damaged" in _error(sensor))
        server.fault()
        assert eventually(lambda: all_valid(sensor))
    dropped = [record for record in caplog.records if "dropped a packet" in record.message]
    assert 1 <= len(dropped) < 8 < sensor.counts().malformed  # a warning a second, however many there are


def test_garbage_between_the_frames_harms_nothing(server: NatNetServer, sensor: OptiTrackSensor) -> None:
    server.fault(garbage=5)
    for _ in range(50):
        assert next_sample(sensor).valid.all()
    counts = sensor.counts()
    assert counts.malformed + counts.unexpected > 100


def test_packets_from_another_sender_are_dropped(server: NatNetServer, sensor: OptiTrackSensor) -> None:
    before = next_sample(sensor)
    server.fault(foreign="127.0.0.2")  # with frame numbers ahead, and bodies a metre away
    for _ in range(50):
        sample = next_sample(sensor)
        assert sample.valid.all()
        np.testing.assert_allclose(sample.T, REST, atol=2e-4)
    counts = sensor.counts()
    assert counts.foreign > 40 and counts.out_of_order == 0 and sample.sequence < before.sequence + 900


def test_duplicates_and_frames_out_of_order_are_dropped(server: NatNetServer, sensor: OptiTrackSensor) -> None:
    server.fault(duplicate=True)
    assert all(next_sample(sensor).valid.all() for _ in range(20))
    assert sensor.counts().repeated > 10
    server.fault(reorder=True)
    numbers = [next_sample(sensor).sequence for _ in range(20)]
    assert (np.diff(numbers) > 0).all() and sensor.counts().out_of_order > 5
    assert sensor.counts().restarts == 0


@pytest.mark.parametrize("step", [5.0, -5.0])
def test_a_clock_that_was_set_is_followed(server: NatNetServer, sensor: OptiTrackSensor, step: float) -> None:
    server.fault(clock_step=step)
    assert eventually(lambda: sensor.counts().clock_steps == 1)
    sample = next_sample(sensor, 10)
    assert -1e-3 < time.monotonic() - sample.stamp < 0.5 and sample.valid.all()
