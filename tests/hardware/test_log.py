"""Logs: every number comes back, from whole files and from cut ones, with our reader and with another."""

from __future__ import annotations

import errno
import json
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.hardware.log import RunLog
from apcc_torch.hardware.log_export import columns, write_parquet, write_recording, write_rerun
from apcc_torch.hardware.log_format import Field, Layout, layout_of, layouts
from apcc_torch.hardware.log_reader import RobotLog, read_log
from apcc_torch.hardware.records import Tick
from apcc_torch.hardware.stops import StopReason
from apcc_torch.recordings.recording_file import load_recording
from fake_devices import Fault
from fake_runs import FakeRun, fake_run

LAYOUTS = layouts(9, 3, 3, 9)


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> tuple[FakeRun, Path]:
    """A run with a few blind turns, and its log."""
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    with RunLog(path.open("wb"), LAYOUTS, 1e9, {"versions": {"torch": "2"}}, {"config.yaml": "rate: 100\n"}) as log:
        run = fake_run([Fault("nan", 0.5, 0.6), Fault("read_fails", 0.7, 0.73)], observers=(log,))
    return run, path


@given(st.lists(st.floats(width=64), min_size=4, max_size=4), st.integers(-(2**63), 2**63 - 1))
def test_a_message_comes_back_to_the_last_bit(floats: list[float], integer: int) -> None:
    layout = Layout(
        "Some",
        "/some",
        (Field("a", "float64", 3, "m"), Field("b", "int64", None, "1: yes"), Field("c", "float64", None, "s")),
    )
    rows = layout.unpack([layout.pack(floats[:3], integer, floats[3])] * 2)
    assert rows.shape == (2,)
    assert np.array_equal(rows["a"][1], floats[:3], equal_nan=True) and int(rows["b"][0]) == integer
    assert layout_of(layout.schema_name, layout.topic, layout.definition) == layout


def test_the_log_holds_the_run(logged: tuple[FakeRun, Path]) -> None:
    run, path = logged
    log = read_log(path)
    assert log.complete and log.metadata == {"versions": {"torch": "2"}}
    assert log.attachments == {"config.yaml": "rate: 100\n"}
    ticks = run.witness.ticks
    assert np.array_equal(log.topic("/timing")["tick"], [tick.index for tick in ticks])
    decided = [tick for tick in ticks if tick.decision is not None]
    assert np.array_equal(log.topic("/controller")["tick"], [tick.index for tick in decided])
    assert np.array_equal(log.topic("/controller")["y"], [t.decision.y for t in decided if t.decision])
    assert np.array_equal(log.topic("/target")["x_d"], [t.decision.x_d for t in decided if t.decision])
    seen = [tick.frame for tick in ticks if tick.frame is not None]
    assert np.array_equal(log.topic("/measurement")["poses"], [s.T.ravel() for s in seen])
    assert np.array_equal(log.topic("/measurement")["position_ok"], [s.position_ok for s in seen])
    assert len(decided) < len(seen) < len(ticks) and not log.topic("/measurement")["usable"].all()
    tendons = log.topic("/tendons")
    assert np.array_equal(tendons["requested"], [tick.requested for tick in ticks])
    assert (tendons["read"] == 0).sum() == sum(tick.reading is None for tick in ticks) > 0
    assert len(log.topic("/tendons/raw")) == len(ticks) - (tendons["read"] == 0).sum()
    assert [e["message"] for e in log.events] == [event.message for event in run.witness.events]
    with pytest.raises(DataError, match="no messages of /force"):
        log.topic("/force")


def test_another_decoder_reads_the_same(logged: tuple[FakeRun, Path]) -> None:
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    log = read_log(logged[1])
    rows: dict[str, list[object]] = {}
    with logged[1].open("rb") as file:
        factories = [decoder.DecoderFactory()]
        for _, channel, _, message in reader.make_reader(file, decoder_factories=factories).iter_decoded_messages(
            topics=["/controller", "/tendons", "/timing", "/measurement"]
        ):
            rows.setdefault(channel.topic, []).append(message)
    assert set(rows) == {"/controller", "/tendons", "/timing", "/measurement"}
    for topic, messages in rows.items():
        ours = log.topic(topic)
        for name in ours.dtype.names or ():
            theirs = np.array([getattr(message, name) for message in messages])
            assert np.array_equal(theirs, ours[name], equal_nan=True), (topic, name)


def test_a_file_cut_anywhere_gives_what_came_before(logged: tuple[FakeRun, Path], tmp_path: Path) -> None:
    whole = logged[1].read_bytes()
    full = read_log(logged[1])
    cut = tmp_path / "cut.mcap"
    lengths = []
    for end in np.linspace(200, len(whole) - 1, 60).astype(int):
        cut.write_bytes(whole[:end])
        log = read_log(cut)
        assert not log.complete
        for topic, rows in log.topics.items():
            assert np.array_equal(rows, full.topics[topic][: len(rows)]) or _same(rows, full.topics[topic][: len(rows)])
        lengths.append(len(log.topics.get("/timing", ())))
    assert lengths == sorted(lengths)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return all(np.array_equal(a[name], b[name], equal_nan=True) for name in a.dtype.names or ())


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        read_log(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("time,y\n0,1\n")
    with pytest.raises(DataError, match="not the log of a run"):
        read_log(tmp_path / "text.mcap")


class FullDisk:
    """A file on a disk with room for so many bytes."""

    def __init__(self, path: Path, room: int) -> None:
        self.file = path.open("wb")
        self.room = room

    def write(self, data: bytes) -> int:
        if self.file.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.file.write(data)

    def tell(self) -> int:
        return self.file.tell()

    def flush(self) -> None:
        self.file.flush()

    def __enter__(self) -> FullDisk:
        return self

    def __exit__(self, *unused: object) -> None:
        self.file.close()


class Paced:
    """Waits each turn until the log's thread has caught up, as real time would let it."""

    def __init__(self, log: RunLog) -> None:
        self.log = log

    def on_start(self, start: object, time: float) -> None: ...

    def on_event(self, event: object) -> None: ...

    def on_tick(self, tick: Tick) -> None:
        end = time.monotonic() + 5.0
        while not self.log.queue.empty() and self.log.thread.is_alive() and time.monotonic() < end:
            time.sleep(1e-4)

    def failure(self) -> str | None:
        return None


def test_a_full_disk_stops_the_run_with_the_arm_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apcc_torch.hardware.log.FLUSH", 0.0)
    path = tmp_path / "log.mcap"
    with RunLog(FullDisk(path, 20_000), LAYOUTS, 0.0, {"versions": {}}, {}) as log:  # type: ignore[arg-type]
        run = fake_run(observers=(log, Paced(log)), duration=30.0)
    assert run.outcome.reason is StopReason.LOG_FAILED and "No space left" in run.outcome.message
    assert run.outcome.ticks > 5 and run.actuator.held and not run.actuator.torque
    assert len(read_log(path).topic("/timing")) > 0, "what was written can be read"


def test_a_log_that_cannot_keep_up_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apcc_torch.hardware.log.BACKLOG", -1)
    with RunLog((tmp_path / "log.mcap").open("wb"), LAYOUTS, 0.0, {}, {}) as log:
        assert "behind" in str(log.failure())


def test_parquet_has_every_topic_and_number(logged: tuple[FakeRun, Path], tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    log = read_log(logged[1])
    written = {path.stem: parquet.read_table(path).to_pydict() for path in write_parquet(log, tmp_path)}
    assert set(written) == {
        "start",
        "measurement",
        "target",
        "controller",
        "tendons",
        "tendons_raw",
        "timing",
        "events",
    }
    assert np.array_equal(written["tendons"]["y_9"], log.topic("/tendons")["y"][:, 8])
    assert written["events"]["kind"] == [event["kind"] for event in log.events]
    assert list(columns(log.topic("/target"))) == [
        "tick",
        "time",
        "x_d_1",
        "x_d_2",
        "x_d_3",
        "xdot_d_1",
        "xdot_d_2",
        "xdot_d_3",
    ]


def test_a_recording_of_it_holds_every_new_frame(logged: tuple[FakeRun, Path], tmp_path: Path) -> None:
    log = read_log(logged[1])
    recording = load_recording(write_recording(log, tmp_path / "recording.csv"))
    frames = log.topic("/measurement")
    _, first = np.unique(frames["sequence"], return_index=True)
    poses = frames["poses"][first].reshape(-1, 3, 4, 4)
    seen = recording.tracked.numpy()
    assert len(recording) == len(first) and seen.any() and not seen.all()
    assert np.array_equal(recording.position.numpy()[seen], poses[..., :3, 3][seen])
    assert np.allclose(recording.rotation.numpy()[seen], poses[..., :3, :3][seen], atol=1e-12)
    tendons = {int(row["tick"]): row for row in log.topic("/tendons")}
    ticks = [int(tick) for tick in frames["tick"][first]]
    assert recording.inputs is not None and recording.actuators is not None
    for k, tick in enumerate(ticks):
        if tick in tendons:
            assert np.array_equal(recording.inputs[k].numpy(), -tendons[tick]["sent"])
            assert np.array_equal(recording.actuators[k].numpy(), -tendons[tick]["y"])


def test_rerun_is_a_choice(logged: tuple[FakeRun, Path], tmp_path: Path) -> None:
    log: RobotLog = read_log(logged[1])
    try:
        import rerun  # noqa: F401
    except ImportError:
        with pytest.raises(ConfigError, match="pip install rerun-sdk"):
            write_rerun(log, tmp_path / "log.rrd")
    else:
        assert write_rerun(log, tmp_path / "log.rrd").stat().st_size > 10_000
    assert json.dumps(log.events)
