"""The sensor on a NatNet server of another process: the handshake, samples, silence, restarts, and a clean end."""

from __future__ import annotations

import dataclasses
import os
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from apcc_torch.errors import CommunicationError, HardwareError, ShapeError, ValueRangeError
from apcc_torch.hardware.mocap.gate import Reason
from apcc_torch.hardware.mocap.tracker import MocapSample, Tracker
from apcc_torch.hardware.optitrack.sensor import OptiTrackSensor
from hardware.emulators.mocap_server import standing
from hardware.emulators.natnet_layout import VERSIONS, Version
from hardware.emulators.natnet_server import NatNetServer
from hardware.optitrack.served import (
    RATE,
    all_valid,
    connected,
    eventually,
    next_sample,
    renew,
    sample_beyond,
    sensor_for,
)
from hardware.optitrack.test_tracker import expected


@pytest.fixture(scope="module")
def running() -> Iterator[NatNetServer]:
    with NatNetServer(rate=RATE) as server:
        yield server


@pytest.fixture
def server(running: NatNetServer) -> NatNetServer:
    renew(running)
    return running


def open_sockets() -> int:
    links = [os.path.join("/proc/self/fd", name) for name in os.listdir("/proc/self/fd")]
    return sum(os.path.exists(link) and os.readlink(link).startswith("socket:") for link in links)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("ticks", [True, False])
def test_every_version_gives_poses_in_the_base_frame(server: NatNetServer, version: Version, ticks: bool) -> None:
    renew(server, version=version, ticks=ticks)
    with connected(server) as sensor:
        sample = next_sample(sensor, 3)
        assert sample.valid.all() and sample.reasons == (Reason.OK,) * 3
        np.testing.assert_allclose(sample.T, expected(standing(4)), atol=2e-4)
        assert -1e-3 < time.monotonic() - sample.stamp < sensor.settings.max_age
        info = sensor.server
        assert info is not None and (info.name, info.version) == ("Motive", version)
        counts = sensor.counts()
        assert counts.malformed == counts.foreign == counts.socket_errors == counts.unexpected == 0


def test_bodies_come_in_the_order_of_their_names(server: NatNetServer) -> None:
    with connected(server, bodies=("disk_3", "disk_1")) as sensor:
        assert sensor.n_bodies == 2
        np.testing.assert_allclose(next_sample(sensor).T, expected(standing(4))[[2, 0]], atol=2e-4)


def test_samples_follow_the_arm(server: NatNetServer) -> None:
    poses = standing(4)
    with connected(server) as sensor:
        poses[1:, 0] += 0.005
        changed = server.set_poses(poses)
        np.testing.assert_allclose(sample_beyond(sensor, changed).T, expected(poses), atol=2e-4)


def test_wait_gives_each_frame_once_and_latest_never_waits(server: NatNetServer) -> None:
    with connected(server) as sensor:
        numbers = [sample.sequence for sample in (next_sample(sensor) for _ in range(20))]
        assert (np.diff(numbers) > 0).all()
        server.fault(stop=True)
        time.sleep(0.05)
        last = sensor.latest()
        assert last is not None
        began = time.monotonic()
        assert sensor.wait(0.1, after=last.sequence) is None
        assert 0.09 < time.monotonic() - began < 0.4
        assert sensor.wait(0.1, after=last.sequence - 1) is not None


def test_nobody_answers() -> None:
    with NatNetServer() as server:
        port = server.command_port
    quiet = sensor_for(server, connect_timeout=0.4)
    with pytest.raises(CommunicationError, match=f"no NatNet server answers at 127.0.0.1:{port} within 0.4 s"):
        quiet.connect()
    quiet.disconnect()


def test_a_silent_server_and_a_server_without_names(server: NatNetServer) -> None:
    server.fault(stop=True)
    with pytest.raises(CommunicationError, match="streams no frames"):
        sensor_for(server, connect_timeout=0.4).connect()
    server.fault()
    with pytest.raises(HardwareError, match="no rigid body disk_9; it has base, disk_1, disk_2, disk_3"):
        sensor_for(server, bodies=("disk_1", "disk_9")).connect()


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ({1: "base", 2: "disk_1", 3: "disk_1", 4: "disk_2", 5: "disk_3"}, "two rigid bodies named disk_1"),
        ({1: "base", 2: "disk_1", 3: "disk_2", 4: "disk_3", 5: "stand", 6: "stand"}, None),
    ],
)
def test_two_bodies_of_one_name_matter_where_it_is_one_of_ours(
    server: NatNetServer, names: dict[int, str], said: str | None
) -> None:
    renew(server, names=names, poses=standing(len(names)))
    if said is None:
        with connected(server) as sensor:
            assert sensor.wait(2.0) is not None
        return
    with pytest.raises(HardwareError, match=said):
        sensor_for(server).connect()


def test_an_unknown_version_is_refused_in_a_sentence(server: NatNetServer) -> None:
    renew(server, version=(4, 3))
    with pytest.raises(HardwareError, match=r"'Motive' streams NatNet 4\.3; known are 3\.0, 3\.1, 4\.0, 4\.1, 4\.2"):
        sensor_for(server).connect()


def test_a_base_that_is_not_seen_cannot_be_measured(server: NatNetServer) -> None:
    server.fault(untracked=[1])
    with pytest.raises(HardwareError, match=r"'base' could not be measured in \d+ frames: .*untracked"):
        sensor_for(server, connect_timeout=0.4).connect()


def test_an_earlier_base_needs_no_measurement(server: NatNetServer) -> None:
    with connected(server) as sensor:
        base = sensor.base
    server.fault(untracked=[1])
    with OptiTrackSensor(sensor.settings, base=base) as again:
        assert next_sample(again, 2).valid.all()
    moving = sensor_for(server, static_base=False).settings
    with pytest.raises(ValueRangeError, match="base must not be given"):
        OptiTrackSensor(moving, base=base)
    with pytest.raises(ShapeError, match="base must have shape"):
        OptiTrackSensor(sensor.settings, base=np.eye(3))


def test_a_wrong_interface_is_named(server: NatNetServer) -> None:
    with pytest.raises(CommunicationError, match=r"cannot listen on interface 192\.0\.2\.1: "):
        sensor_for(server, interface="192.0.2.1").connect()


def test_a_stream_that_stops_ends_the_source_and_a_restart_brings_it_back(server: NatNetServer) -> None:
    with connected(server) as sensor:
        server.fault(stop=True)
        before = sensor.latest()
        assert before is not None
        # First the sample grows old: it is handed out with nothing valid.
        assert eventually(lambda: not sensor.latest().valid.any())  # type: ignore[union-attr]
        old = sensor.latest()
        assert old is not None and old.reasons == (Reason.LATE,) * 3 and np.isnan(old.T).all()
        time.sleep(sensor.settings.timeout)
        with pytest.raises(CommunicationError, match=r"no new frame of motion capture for \d\.\d+ s: \d+ packets came"):
            sensor.latest()
        server.fault()
        assert eventually(lambda: sensor.wait(0.1, after=old.sequence) is not None)
        assert eventually(lambda: next_sample(sensor).valid.all())


def test_the_sample_after_connecting_is_of_the_measured_base(
    server: NatNetServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, sensor = Tracker._sample, sensor_for(server)

    def slow(tracker: Tracker, *given: object) -> MocapSample:
        # Who waits for the base wakes up between its measurement and the first sample that uses it.
        with sensor._changed:
            sensor._changed.notify_all()
        time.sleep(0.02)
        return made(tracker, *given)  # type: ignore[arg-type]

    monkeypatch.setattr(Tracker, "_sample", slow)
    with sensor:
        sample = sensor.latest()
        assert sample is not None and sample.base_reason is Reason.OK and sample.valid.all()


def test_a_server_that_starts_again_with_other_numbers_is_asked_anew(server: NatNetServer) -> None:
    with connected(server) as sensor:
        other = {11: "disk_3", 12: "disk_2", 13: "disk_1", 14: "base"}
        server.restart(names=other, poses=standing(4)[::-1].copy())
        assert eventually(lambda: sensor.counts().losses > 0 and all_valid(sensor))
        # The base is still where it was measured, and every name means the same body as before.
        np.testing.assert_allclose(next_sample(sensor).T, expected(standing(4)), atol=2e-4)


def test_a_server_that_comes_back_with_an_unknown_version_is_refused(server: NatNetServer) -> None:
    with connected(server) as sensor:
        server.restart(version=(5, 0))
        assert eventually(lambda: _refused(sensor))
        with pytest.raises(HardwareError, match=r"streams NatNet 5\.0"):
            sensor.wait(0.1, after=0)
        server.restart(version=(4, 2))
        assert eventually(lambda: all_valid(sensor))


def _refused(sensor: OptiTrackSensor) -> bool:
    try:
        sensor.latest()
    except HardwareError as error:
        return "streams NatNet" in str(error)
    return False


def test_a_server_that_is_killed_ends_the_source() -> None:
    with NatNetServer(rate=RATE) as server, connected(server) as sensor:
        server.kill()
        time.sleep(sensor.settings.timeout + 0.2)
        with pytest.raises(CommunicationError, match="no new frame"):
            sensor.latest()


def test_a_clean_end_and_a_new_beginning(server: NatNetServer) -> None:
    threads, sockets = threading.active_count(), open_sockets()
    sensor = sensor_for(server)
    with pytest.raises(HardwareError, match="not connected"):
        sensor.latest()
    sensor.disconnect()
    for _ in range(3):
        sensor.connect()
        with pytest.raises(HardwareError, match="already connected"):
            sensor.connect()
        assert threading.active_count() == threads + 1
        assert next_sample(sensor).valid.all()
        sensor.disconnect()
        sensor.disconnect()
        assert (threading.active_count(), open_sockets()) == (threads, sockets)
    with pytest.raises(HardwareError, match="not connected"):
        sensor.latest()
    for failing in ({"bodies": ("nobody",)}, {"command_port": 1, "connect_timeout": 0.1}):
        with pytest.raises(HardwareError):
            OptiTrackSensor(dataclasses.replace(sensor.settings, **failing)).connect()
    assert (threading.active_count(), open_sockets()) == (threads, sockets)


def test_a_wait_ends_when_the_sensor_is_disconnected(server: NatNetServer) -> None:
    sensor = sensor_for(server)
    sensor.connect()
    server.fault(stop=True)
    time.sleep(0.05)
    last = sensor.latest()
    assert last is not None
    closing = threading.Timer(0.1, sensor.disconnect)
    closing.start()
    began = time.monotonic()
    with pytest.raises(HardwareError, match="not connected"):
        sensor.wait(10.0, after=last.sequence)
    assert time.monotonic() - began < 5.0
    closing.join()


def test_two_sensors_on_one_server(server: NatNetServer) -> None:
    with connected(server) as one, connected(server, bodies=("disk_2",), up="y") as two:
        for _ in range(20):
            assert next_sample(one).valid.all() and next_sample(two).valid.all()
        assert one.counts().malformed == two.counts().malformed == 0
        assert next_sample(one).T.shape == (3, 4, 4) and next_sample(two).T.shape == (1, 4, 4)
