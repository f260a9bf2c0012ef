"""The sensor against QTM's server in another process: handshake, both transports, faults, and what is refused."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from apcc_torch.errors import CommunicationError, ConfigError, HardwareError, ValueRangeError
from apcc_torch.hardware.mocap.gate import Reason
from apcc_torch.hardware.mocap.sensor import MocapSensor
from apcc_torch.hardware.qualisys.sensor import QualisysSensor
from apcc_torch.hardware.qualisys.settings import QualisysSettings
from hardware.emulators.mocap_server import standing
from hardware.emulators.qtm_server import QtmServer
from hardware.optitrack.served import all_valid, eventually, sample_beyond
from hardware.optitrack.test_tracker import expected

RATE = 50.0
REST = expected(standing(4))
PATIENT = 20.0  # s that a busy machine may take


@pytest.fixture(scope="module")
def running() -> Iterator[QtmServer]:
    with QtmServer(rate=RATE) as server:
        yield server


@pytest.fixture
def server(running: QtmServer) -> QtmServer:
    running.fault()
    running.restart(version=(1, 27), names={1: "base", 2: "disk_1", 3: "disk_2", 4: "disk_3"})
    return running


def settings(server: QtmServer, **changes: object) -> QualisysSettings:
    given: dict[str, object] = {
        "bodies": ("disk_1", "disk_2", "disk_3"), "port": server.command_port, "base_frames": 3, "max_age": 2.0,
        "timeout": 5.0, "connect_timeout": PATIENT, **changes,
    }  # fmt: skip
    return QualisysSettings(**given)  # type: ignore[arg-type]


def test_poses_come_in_the_base_frame_over_either_transport(server: QtmServer) -> None:
    for transport in ("udp", "tcp"):
        with QualisysSensor(settings(server, transport=transport)) as sensor:
            assert isinstance(sensor, MocapSensor) and sensor.version == "1.25"
            assert sensor.names == ("disk_1", "disk_2", "disk_3") and sensor.base is not None
            assert eventually(lambda: all_valid(sensor), PATIENT)
            sample = sensor.latest()
            assert sample is not None and 0.0 <= time.monotonic() - sample.stamp < 5.0
            np.testing.assert_allclose(sample.T, REST, atol=2e-4)
            assert sensor.counts().failed == 0 and sensor.counts().malformed == 0


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"untracked": [3]}, Reason.UNTRACKED),
        ({"nan": [3]}, Reason.NON_FINITE),
        ({"zero_quaternion": [3]}, Reason.BAD_QUATERNION),
        ({"stretch": {3: 1.05}}, Reason.BAD_QUATERNION),
    ],
)
def test_a_bad_body_is_not_valid_and_comes_back(server: QtmServer, fault: dict[str, object], reason: Reason) -> None:
    with QualisysSensor(settings(server)) as sensor:
        sample = sample_beyond(sensor, server.fault(**fault), PATIENT)
        assert sample.reasons == (Reason.OK, reason, Reason.OK) and np.isnan(sample.T[1]).all()
        server.fault()
        assert eventually(lambda: all_valid(sensor), PATIENT)


def test_garbage_other_senders_and_copies_change_nothing(server: QtmServer) -> None:
    with QualisysSensor(settings(server)) as sensor:
        changed = server.fault(garbage=3, foreign="127.0.0.2", duplicate=True)
        assert eventually(lambda: sensor.counts().foreign > 5 and sensor.counts().malformed > 5, PATIENT)
        assert sample_beyond(sensor, changed + 5, PATIENT).sequence < 1000 + changed
        counts = sensor.counts()
        assert counts.failed == 0 and counts.repeated > 0 and counts.clock_steps == 0


def test_a_stream_over_tcp_that_loses_its_order_is_begun_anew(server: QtmServer) -> None:
    with QualisysSensor(settings(server, transport="tcp", timeout=PATIENT)) as sensor:
        server.fault(truncate=60)
        assert eventually(lambda: sensor.counts().malformed > 0 or sensor.counts().losses > 0, PATIENT)
        last = server.fault()
        assert sample_beyond(sensor, last, PATIENT).sequence > last
        assert eventually(lambda: all_valid(sensor), PATIENT) and sensor.counts().failed == 0


def test_a_server_that_is_started_again_is_followed_with_its_new_order_of_bodies(server: QtmServer) -> None:
    with QualisysSensor(settings(server, timeout=PATIENT)) as sensor:
        server.restart(names={4: "disk_3", 1: "base", 2: "disk_1", 3: "disk_2"}, poses=standing(4)[[3, 0, 1, 2]])
        assert eventually(lambda: sensor._named is not None and sensor._named[0] == ("disk_3", 0), PATIENT)
        assert eventually(lambda: all_valid(sensor), PATIENT)
        sample = sensor.latest()
        assert sample is not None
        np.testing.assert_allclose(sample.T, REST, atol=2e-4)


def test_a_stream_that_stops_is_said_to_have_ended(server: QtmServer) -> None:
    with QualisysSensor(settings(server, max_age=0.1, timeout=0.5)) as sensor:
        server.fault(stop=True)
        said = None
        for _ in range(200):
            try:
                sensor.latest()
            except CommunicationError as error:
                said = str(error)
                break
            time.sleep(0.05)
        assert said is not None and "no new frame of motion capture" in said


def test_what_cannot_be_used_is_refused_by_name(server: QtmServer) -> None:
    with (
        pytest.raises(HardwareError, match="no rigid body disk_9; it has base, disk_1"),
        QualisysSensor(settings(server, bodies=("disk_9",))),
    ):
        pass
    server.restart(version=(1, 8))
    with (
        pytest.raises(HardwareError, match=r"QTM does not speak version 1\.25 of its protocol: Version NOT supported"),
        QualisysSensor(settings(server)),
    ):
        pass
    server.restart(version=(1, 27))
    server.fault(mute=True)
    with (
        pytest.raises(CommunicationError, match=r"no QTM answers at 127\.0\.0\.1:\d+ within 0\.5 s"),
        QualisysSensor(settings(server, connect_timeout=0.5)),
    ):
        pass
    sensor = QualisysSensor(settings(server))
    sensor.disconnect()
    with pytest.raises(HardwareError, match="not connected"):
        sensor.latest()


@pytest.mark.parametrize(
    ("changes", "error", "named"),
    [
        ({"server": "qtm"}, ConfigError, "server must be an IPv4 address"),
        ({"interface": "0.0.0.0"}, ConfigError, "interface must be one address"),
        ({"server": "239.1.1.1"}, ConfigError, "server must not be a multicast address"),
        ({"transport": "serial"}, ConfigError, "transport must be one of udp, tcp"),
        ({"bodies": ()}, ConfigError, "bodies must name"),
        ({"timeout": 0.05}, ValueRangeError, "timeout must be longer"),
    ],
)
def test_settings_say_what_is_wrong(changes: dict[str, object], error: type[Exception], named: str) -> None:
    with pytest.raises(error, match=named):
        QualisysSettings(**changes)  # type: ignore[arg-type]
    assert QualisysSettings().scale == 1e-3  # QTM streams mm
