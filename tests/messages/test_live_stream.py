"""The live stream: another library's client subscribes and reads it, and one that stalls delays nobody."""

from __future__ import annotations

import base64
import json
import socket
import struct
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apcc_torch.errors import ConfigError
from apcc_torch.hardware.records import Tick
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.live_process import Watched
from apcc_torch.viewing.live_view import LiveView
from apcc_torch.viewing.outline import Outline
from apcc_torch.web_address import StreamAddress
from fake_runs import FakeRun, builder, fake_run

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
pytest.importorskip("mcap")

from mcap.records import Schema

client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
protobuf = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed")
ros2 = pytest.importorskip("mcap_ros2.decoder", reason="mcap-ros2-support is not installed")

PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Names of Foxglove's protocol, today's and the one before."""
TOPICS = {
    "/tf": "foxglove.FrameTransforms",
    "/sensors": "foxglove.PosesInFrame",
    "/tip": "foxglove.PoseInFrame",
    "/target": "foxglove.PoseInFrame",
    "/arm": "foxglove.SceneUpdate",
    "/remarks": "foxglove.Log",
    "/run": "apcc_torch/msg/Run",
}
SOON = 60.0
"""s that something may take on a busy machine."""


class Paced:
    """Lets the copies and the stream come between the turns of a run that takes no time of its own."""

    def on_start(self, start: object, time: float) -> None: ...

    def on_event(self, event: object) -> None: ...

    def on_tick(self, tick: Tick) -> None:
        time.sleep(2e-3)

    def failure(self) -> str | None:
        return None


class Client:
    """A client of Foxglove's protocol that subscribes to every topic."""

    def __init__(self, url: str) -> None:
        self.socket = client.connect(url, subprotocols=PROTOCOLS, max_size=None)
        self.channels: dict[int, dict[str, Any]] = {}
        self.messages: dict[str, list[tuple[int, Any]]] = defaultdict(list)
        self.decoders: dict[int, Any] = {}
        end = time.monotonic() + SOON
        while len(self.channels) < len(TOPICS):
            assert time.monotonic() < end, "the topics were not advertised"
            told = json.loads(self.socket.recv(timeout=SOON))
            for channel in told.get("channels", ()):
                self.channels[channel["id"]] = channel
        wanted = [{"id": number, "channelId": number} for number in self.channels]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def read(self) -> None:
        """Takes what has come, until the server is gone."""
        while True:
            try:
                frame = self.socket.recv(timeout=SOON)
            except Exception:  # the server ends with the run
                return
            if isinstance(frame, bytes) and frame[0] == 1:
                number, stamp = struct.unpack_from("<IQ", frame, 1)
                self.messages[self.channels[number]["topic"]].append((stamp, self.decode(number, frame[13:])))

    def decode(self, number: int, content: bytes) -> Any:
        """A message by the schema that its channel was advertised with."""
        if number not in self.decoders:
            channel = self.channels[number]
            described, text = channel["schemaEncoding"], channel["schema"]
            data = base64.b64decode(text) if described == "protobuf" else text.encode()
            factory = {"protobuf": protobuf, "ros2msg": ros2}[described].DecoderFactory()
            schema = Schema(id=number + 1, name=channel["schemaName"], encoding=described, data=data)
            self.decoders[number] = factory.decoder_for(channel["encoding"], schema)
        return self.decoders[number](content)


def streamed() -> LiveView:
    from apcc_torch.messages.live_stream import STREAM

    build = builder()
    outline = Outline(build.backbone(), build.n_sections, build.routing())
    watched = Watched("a run", DrawnSize.of(build.arm), outline, build.sensors_at().shape[-1])
    return LiveView(watched, StreamAddress(port=0), STREAM, offset=1e9)


@pytest.fixture(scope="module")
def watched_run() -> tuple[FakeRun, Client]:
    """A run that one client watched, beside one that never read on."""
    with streamed() as view:
        url = f"ws://{view.address.host}:{view.address.port}"
        assert view.address.host == "127.0.0.1", "it is served to this machine alone"
        with socket.create_connection((view.address.host, view.address.port)) as plain:
            plain.settimeout(SOON)  # it speaks the protocol's first words, and then says and reads nothing
            stalled = Client(url)
            reader = Client(url)
            run = fake_run(observers=(view, Paced()))
        reader_end = view.copies
    reader.read()
    stalled.socket.close_socket()
    assert reader_end > 0
    return run, reader


def test_every_topic_is_of_its_schema_and_decodes(watched_run: tuple[FakeRun, Client]) -> None:
    _, reader = watched_run
    assert reader.socket.subprotocol in PROTOCOLS
    assert {channel["topic"]: channel["schemaName"] for channel in reader.channels.values()} == TOPICS
    assert set(reader.messages) == set(TOPICS), "all of them have messages"


def test_messages_are_the_runs(watched_run: tuple[FakeRun, Client]) -> None:
    run, reader = watched_run
    decided = {t.decision.time: t for t in run.witness.ticks if t.decision is not None}
    starts = [tick.now - tick.time for tick in run.witness.ticks]
    for stamp, numbers in reader.messages["/run"]:
        tick = decided[numbers.time]
        assert tick.decision is not None
        assert np.array_equal(numbers.target, tick.decision.x_d)
        assert numbers.error == pytest.approx(np.linalg.norm(tick.decision.e))
        assert stamp == pytest.approx(1e18 + 1e9 * (starts[0] + numbers.time), abs=1e3)
    by_stamp = dict(reader.messages["/run"])
    for stamp, poses in reader.messages["/sensors"]:
        frame = decided[by_stamp[stamp].time].frame
        assert frame is not None and poses.frame_id == "world"
        seen = [T for T, ok in zip(frame.T, frame.position_ok & frame.orientation_ok, strict=True) if ok]
        told = [[p.position.x, p.position.y, p.position.z] for p in poses.poses]
        assert np.array_equal(told, [T[:3, 3] for T in seen])
    names = {t.child_frame_id for _, message in reader.messages["/tf"] for t in message.transforms}
    assert names == {"base", "tip", "sensor_1", "sensor_2", "sensor_3"}
    entities = {entity.id for _, scene in reader.messages["/arm"] for entity in scene.entities}
    assert {"section_1", "section_2", "section_3", "backbone", "tendons", "sensors", "target"} <= entities
    assert reader.messages["/remarks"][-1][1].message.startswith("disarmed")


def test_a_client_that_reads_nothing_holds_up_nobody() -> None:
    from apcc_torch.messages.foxglove_library import foxglove
    from apcc_torch.messages.live_stream import BACKLOG
    from apcc_torch.messages.topic import ServerSink, Topic

    library = foxglove()
    context = library.Context()
    server = library.start_server(host="127.0.0.1", port=0, context=context, message_backlog_size=BACKLOG)
    sink, topic = ServerSink(context), Topic("/large", "json", "", "", b"")
    sink.advertise(topic)
    url = f"ws://127.0.0.1:{server.port}"
    stalled, reader = (client.connect(url, subprotocols=PROTOCOLS, max_size=None, max_queue=1) for _ in range(2))
    for each in (stalled, reader):
        number = next(c["id"] for c in _channels(each) if c["topic"] == "/large")
        each.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": number}]}))
    content, many, begun, got = bytes(2**18), 16 * BACKLOG, threading.Event(), []

    def read() -> None:
        while not got or got[-1] != many - 1:
            frame = reader.recv(timeout=SOON)
            if isinstance(frame, bytes):
                got.append(struct.unpack_from("<IQ", frame, 1)[1])
                begun.set()

    listening = threading.Thread(target=read, daemon=True)
    listening.start()
    while not begun.is_set():  # a subscription takes effect in its own time
        sink.add(topic, b"{}", 0, 0)
        begun.wait(0.01)
    # A quarter of a GiB, which no socket holds: were the stalled client waited for, this would not end.
    for k in range(many):
        sink.add(topic, content, k, k)
        while got[-1] < k - BACKLOG // 2:
            time.sleep(1e-3)
    listening.join(SOON)
    assert got[-1] == many - 1, "the other client has the last one"
    assert got == sorted(got)
    for each in (stalled, reader):
        each.close_socket()
    server.stop()


def _channels(connection: Any) -> list[dict[str, Any]]:
    while True:
        told = json.loads(connection.recv(timeout=SOON))
        if told["op"] == "advertise":
            channels: list[dict[str, Any]] = told["channels"]
            return channels


def test_clients_change_nothing_of_a_run(watched_run: tuple[FakeRun, Client]) -> None:
    run, _ = watched_run
    unseen = fake_run()
    for one, other in zip(run.witness.ticks, unseen.witness.ticks, strict=True):
        assert one.time == other.time and (one.sent == other.sent).all() and one.overruns == other.overruns


def test_a_port_that_is_taken_is_named(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        view = streamed()
        view.address = StreamAddress(port=taken.getsockname()[1])
        with pytest.raises(ConfigError, match=r"stream\.port=\d+ of 127\.0\.0\.1 cannot be had"), view:
            pass
