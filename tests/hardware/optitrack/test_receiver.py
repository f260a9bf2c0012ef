"""The sockets: where they listen, whom they hear, and a thread that nothing ends; unicast and multicast."""

from __future__ import annotations

import logging
import random
import socket
import time
from collections.abc import Iterator

import pytest

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.optitrack.receiver import Receiver
from apcc_torch.hardware.optitrack.sensor import OptiTrackSensor
from hardware.emulators import natnet_layout as layout
from hardware.emulators.natnet_server import NatNetServer
from hardware.optitrack.served import RATE, all_valid, eventually, next_sample, renew, sensor_for
from hardware.optitrack.streams import NAMES, settings
from hardware.optitrack.test_packets import framed, mutated

GROUP = "239.255.42.99"


class Listener:
    """A receiver whose datagrams are kept, and whose handling fails on demand."""

    def __init__(self, **changes: object) -> None:
        self.taken: list[bytes] = []
        self.error: Exception | None = None
        self.tended = 0
        self.counts = Counts()
        self.receiver = Receiver(settings(**changes), self.counts, self.take, self.tend)
        self.receiver.open()

    def take(self, data: bytes, arrival: float) -> None:
        assert 0 <= time.monotonic() - arrival < 5
        if self.error is not None:
            raise self.error
        self.taken.append(data)

    def tend(self, now: float) -> None:
        self.tended += 1
        if self.error is not None:
            raise self.error


@pytest.fixture
def listener() -> Iterator[Listener]:
    listener = Listener()
    yield listener
    listener.receiver.close()


def sender(address: str = "127.0.0.1") -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((address, 0))
    sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
    return sock


def test_it_listens_on_the_interface_alone(listener: Listener) -> None:
    ((address, port),) = listener.receiver.addresses
    assert address == "127.0.0.1" and port > 0


def test_others_are_counted_and_not_heard(listener: Listener, caplog: pytest.LogCaptureFixture) -> None:
    (address,) = listener.receiver.addresses
    with caplog.at_level(logging.WARNING), sender("127.0.0.2") as other, sender() as server:
        for i in range(30):
            other.sendto(b"wrong", address)
            server.sendto(b"%d" % i, address)
        assert eventually(lambda: listener.counts.packets == 60)
    assert listener.taken == [b"%d" % i for i in range(30)] and listener.counts.foreign == 30
    warnings = [record.getMessage() for record in caplog.records]
    assert warnings == ["dropped a packet from 127.0.0.2, which is not the server"]


@pytest.mark.parametrize("error", [CommunicationError("cut"), KeyError("x"), MemoryError(), RecursionError()])
def test_no_error_ends_the_thread(listener: Listener, error: Exception) -> None:
    (address,) = listener.receiver.addresses
    listener.error = error
    with sender() as server:
        for _ in range(20):
            server.sendto(b"bad", address)
        assert eventually(lambda: listener.counts.packets == 20)
        expected = "malformed" if isinstance(error, CommunicationError) else "failed"
        assert eventually(lambda: getattr(listener.counts, expected) >= 20)
        listener.error = None
        server.sendto(b"good", address)
        assert eventually(lambda: listener.taken == [b"good"])
    assert listener.receiver.running


def test_it_tends_also_when_nothing_comes(listener: Listener) -> None:
    assert eventually(lambda: listener.tended > 3)


def test_an_empty_and_the_largest_datagram(listener: Listener) -> None:
    (address,) = listener.receiver.addresses
    with sender() as server:
        for data in (b"", bytes(65507)):
            server.sendto(data, address)
        assert eventually(lambda: len(listener.taken) == 2)
    assert [len(data) for data in listener.taken] == [0, 65507]


def test_a_failed_send_is_counted(listener: Listener) -> None:
    listener.receiver.send(bytes(70_000))  # longer than any datagram
    assert listener.counts.socket_errors == 1


def test_multicast_is_heard_on_the_group_and_the_interface_alone() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    one, two = (Listener(multicast=True, data_port=port) for _ in range(2))  # two programs on one computer
    try:
        command, data = one.receiver.addresses
        assert command[0] == "127.0.0.1" and data == (GROUP, port)
        with sender() as server, sender("127.0.0.2") as other:
            server.sendto(b"to the group", (GROUP, port))
            other.sendto(b"wrong", (GROUP, port))
            server.sendto(b"to us", ("127.0.0.1", port))  # nobody is there
            assert eventually(lambda: one.taken == two.taken == [b"to the group"])
            assert eventually(lambda: one.counts.foreign == two.counts.foreign == 1)
        assert one.counts.packets == 2
    finally:
        one.receiver.close()
        two.receiver.close()


@pytest.mark.parametrize("version", [(3, 0), (4, 2)])
def test_the_sensor_on_a_multicast_stream(version: tuple[int, int]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with NatNetServer(rate=RATE, group=GROUP, data_port=port, version=version) as server:
        given = {"multicast": True, "data_port": port}
        with sensor_for(server, **given) as one, sensor_for(server, **given) as two:
            assert next_sample(one, 5).valid.all() and next_sample(two, 5).valid.all()
            server.fault(stop=True)
            time.sleep(one.settings.timeout + 0.2)
            with pytest.raises(CommunicationError, match="no new frame"):
                one.latest()
            server.fault()
            assert eventually(lambda: all_valid(one) and all_valid(two))


def test_a_hundred_thousand_mutated_packets_do_not_end_the_thread() -> None:
    """Any damage, and very much of it, through the real socket and the receive thread; then a good stream again."""
    rng = random.Random(7)
    total = Counts()
    with NatNetServer(rate=RATE) as server:
        for version in layout.VERSIONS:
            renew(server, version=version)
            with OptiTrackSensor(sensor_for(server).settings) as sensor, sender() as attacker:
                (address,) = sensor.addresses
                server.fault(stop=True)  # it answers, and the frames are the attacker's
                for begin in range(100, 20_100, 50):
                    taken = sensor.counts().packets
                    for i in range(begin, begin + 50):
                        attacker.sendto(mutated(good(version, i), rng), address)
                    # No faster than they are taken: the socket's buffer is small.
                    assert eventually(lambda: sensor.counts().packets >= taken + 50)  # noqa: B023
                counts = sensor.counts()
                assert counts.failed == 0 and counts.socket_errors == 0
                total.packets += counts.packets
                total.malformed += counts.malformed
                total.frames += counts.frames
                server.fault()
                assert eventually(lambda: all_valid(sensor), timeout=10.0)
    assert total.packets >= 100_000 and total.malformed > 30_000 and total.frames > 10_000, total


def good(version: tuple[int, int], number: int) -> bytes:
    """A packet of a sound stream: mostly frames of rigid bodies alone, some with all else, names and greetings."""
    if number % 50 == 0:
        return layout.model(version, NAMES)
    if number % 50 == 25:
        return layout.server_info(version)
    return framed(version, number, extras=number % 10 == 0)
