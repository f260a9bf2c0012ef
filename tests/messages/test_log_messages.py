"""Logs as files for Foxglove and as bags of ROS 2: other libraries read them, and they hold what the log does."""

from __future__ import annotations

import io
from collections import defaultdict
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from apcc_torch.errors import DataError, WriteError
from apcc_torch.experiments import realtime_run
from apcc_torch.experiments.recorded_run import of_log
from apcc_torch.hardware.log_export import recording_of
from apcc_torch.hardware.log_reader import RobotLog, read_log
from apcc_torch.messages.foxglove_file import write_foxglove
from apcc_torch.messages.log_bag import write_bag
from apcc_torch.model.arm import Arm
from apcc_torch.recordings.recording_file import load_recording
from apcc_torch.robot_log import main
from composed import composed_realtime

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
pytest.importorskip("mcap")

from mcap.records import Message, Schema

from mcap_mutations import records, written

reader = pytest.importorskip("mcap.reader")
protobuf = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed")
ros2 = pytest.importorskip("mcap_ros2.decoder", reason="mcap-ros2-support is not installed")
highlevel = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")

RUN = (
    "experiment=setpoint", "hardware=lockstep", "hardware.world.step=0.01", "plant.settle=0.1", "loop.hold=0.0",
    "figures=false", "loop.warm_up=3", "loop.fresh_frames=1", "experiment.duration=0.3", "view=false", "compile=off",
)  # fmt: skip


ARM = Arm.load("arm_1")


class Logged(NamedTuple):
    """A log, its file, and what was made of it."""

    path: Path
    log: RobotLog
    foxglove: Path
    bag: Path


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Logged:
    folder = tmp_path_factory.mktemp("messages")
    realtime_run.run(composed_realtime(*RUN), folder)
    log = read_log(folder / "log.mcap")
    run = of_log(log, "a run")
    written_files = write_foxglove(run, folder / "foxglove.mcap", log), write_bag(log, folder / "bag", run)
    return Logged(folder / "log.mcap", log, *written_files)


Decoded = dict[str, list[tuple[Any, Any, Any]]]


def decoded(path: Path) -> Decoded:
    """Topic to schema, record and decoded message of each; none of the messages may fail to decode."""
    found: Decoded = defaultdict(list)
    with path.open("rb") as file:
        factories = [protobuf.DecoderFactory(), ros2.DecoderFactory()]
        for schema, channel, message, content in reader.make_reader(
            file, validate_crcs=True, decoder_factories=factories
        ).iter_decoded_messages():
            found[channel.topic].append((schema, message, content))
    return found


def xyzw(quaternion: Any) -> np.ndarray:
    return np.array([getattr(quaternion, axis) for axis in "xyzw"])


def xyz(place: Any) -> np.ndarray:
    return np.array([getattr(place, axis) for axis in "xyz"])


def rotation(quaternion: Any) -> np.ndarray:
    """(3, 3), written out from the definition of a rotation by a quaternion."""
    x, y, z, w = xyzw(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def same_rows(messages: list[tuple[Any, Any, Any]], log: RobotLog, topic: str) -> None:
    rows, stamps = log.topic(topic), log.stamps[topic]
    assert len(messages) == len(rows)
    for name in rows.dtype.names or ():
        theirs = np.array([getattr(content, name) for _, _, content in messages])
        assert np.array_equal(theirs, rows[name], equal_nan=True), (topic, name)
    assert [message.log_time for _, message, _ in messages] == stamps.tolist()


def test_foxglove_has_well_known_schemas_and_every_number_of_the_log(logged: Logged) -> None:
    found = decoded(logged.foxglove)
    names = {topic: messages[0][0].name for topic, messages in found.items() if not topic.startswith("/log")}
    assert names == {
        "/tf": "foxglove.FrameTransforms",
        "/sensors": "foxglove.PosesInFrame",
        "/tip": "foxglove.PoseInFrame",
        "/target": "foxglove.PoseInFrame",
        "/arm": "foxglove.SceneUpdate",
        "/remarks": "foxglove.Log",
        "/run": "apcc_torch/msg/Run",
    }
    for topic in logged.log.topics:
        same_rows(found[f"/log{topic}"], logged.log, topic)
    assert read_log(logged.foxglove).attachments == logged.log.attachments


def test_foxglove_has_the_logs_poses_at_their_own_times(logged: Logged) -> None:
    found, log = decoded(logged.foxglove), logged.log
    frames = log.topic("/measurement")
    poses = frames["poses"].reshape(len(frames), -1, 4, 4)
    assert (frames["position_ok"] == 1).all() and len(found["/sensors"]) == len(frames)
    for (_, message, content), T, time in zip(found["/sensors"], poses, frames["time"], strict=True):
        assert content.frame_id == "world"
        assert np.array_equal([xyz(p.position) for p in content.poses], T[:, :3, 3])
        assert np.allclose([rotation(p.orientation) for p in content.poses], T[:, :3, :3], atol=1e-12)
        stamp = content.timestamp.seconds * 10**9 + content.timestamp.nanos
        assert message.publish_time == stamp == log.began + round(1e9 * time)
    seen = {t.child_frame_id: t for _, _, content in found["/tf"] for t in content.transforms}
    assert set(seen) == {"base", "tip", "sensor_1", "sensor_2", "sensor_3"}
    assert all(t.parent_frame_id == "world" for t in seen.values())
    assert np.allclose(rotation(seen["base"].rotation), np.diag([1.0, -1.0, -1.0]), atol=1e-15), "it hangs"
    assert np.array_equal(xyz(seen["sensor_3"].translation), poses[-1, 2, :3, 3])


def test_the_tip_and_the_drawn_arm_are_the_models(logged: Logged) -> None:
    found, log = decoded(logged.foxglove), logged.log
    steps, targets = log.topic("/controller"), log.topic("/target")
    assert len(found["/run"]) == len(steps)
    before = torch.from_numpy(log.topic("/start")["pi_hat"][0].copy())
    for (_, _, run), (_, _, tip), step, target in zip(found["/run"], found["/tip"], steps, targets, strict=True):
        assert np.array_equal(run.q, step["q_bar"]) and np.array_equal(run.target, target["x_d"])
        assert run.error == pytest.approx(np.linalg.norm(step["e"]), rel=1e-12)
        assert np.array_equal(xyz(tip.pose.position), run.tip)
        model = ARM.backbone().tip(torch.from_numpy(step["q_bar"].copy()), before).numpy()
        assert np.allclose(run.tip, model, atol=1e-12)
        before = torch.from_numpy(step["pi_hat"].copy())
    scene = found["/arm"][-1][2]
    tubes = {entity.id: entity.triangles for entity in scene.entities}
    ends = xyz(tubes["section_3"][0].points[-1])  # the middle of the tube's far end
    nearest = min(np.linalg.norm(ends - np.array(run.tip)) for _, _, run in found["/run"])
    assert nearest < 1e-6
    assert max(tubes["section_1"][0].indices) < len(tubes["section_1"][0].points)


def test_the_bag_opens_in_two_libraries_with_its_types(logged: Logged) -> None:
    file = next(logged.bag.glob("*.mcap"))
    found = decoded(file)
    for topic in logged.log.topics:
        same_rows(found[f"/log{topic}"], logged.log, topic)
    counts: dict[str, int] = defaultdict(int)
    with highlevel.AnyReader([logged.bag]) as bag:  # without types of its own: those in the file must do
        told = next(c.msgdef.data for c in bag.connections if c.topic == "/log/controller")
        assert "float64[9] q_bar  # rad" in told, "units are told"
        for connection, stamp, raw in bag.messages():
            theirs = bag.deserialize(raw, connection.msgtype)
            _, message, ours = found[connection.topic][counts[connection.topic]]
            assert stamp == message.log_time
            if connection.topic == "/log/controller":
                assert np.array_equal(theirs.q_bar, ours.q_bar)
            if connection.topic == "/body2":
                assert np.array_equal(xyz(theirs.pose.position), xyz(ours.pose.position))
            counts[connection.topic] += 1
    assert counts == {topic: len(messages) for topic, messages in found.items()}
    assert {"/tf", "/arm", "/remarks", "/body1", "/inputs", "/actuators", "/target"} <= set(counts)
    frames = {t.child_frame_id for _, _, content in found["/tf"] for t in content.transforms}
    assert frames == {"base", "tip"}


def test_the_bag_is_read_as_the_recording_that_the_log_is(logged: Logged) -> None:
    read, meant = load_recording(logged.bag), recording_of(logged.log)
    assert read.names == tuple(f"/{name}" for name in meant.names)
    assert np.allclose(read.times - 1e-9 * logged.log.began, meant.times, atol=5e-7)
    assert (read.position == meant.position).all() and (read.tracked == meant.tracked).all()
    assert np.allclose(read.quaternion, meant.quaternion, atol=1e-15)
    assert read.inputs is not None and meant.inputs is not None and (read.inputs == meant.inputs).all()
    assert read.actuators is not None and meant.actuators is not None and (read.actuators == meant.actuators).all()
    assert read.target is not None and np.array_equal(read.target[-1], logged.log.topic("/target")["x_d"][-1])


def told(*arguments: str) -> tuple[int, str, str]:
    """Exit code, output and errors of the program."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main(arguments)
    return code, out.getvalue().strip(), err.getvalue()


def test_the_program_writes_both_and_says_where(logged: Logged, tmp_path: Path) -> None:
    for command, name in (("foxglove", "f.mcap"), ("bag", "b")):
        out = tmp_path / name
        assert told(command, str(logged.path), "--out", str(out)) == (0, str(out), "")
    assert decoded(tmp_path / "f.mcap").keys() == decoded(logged.foxglove).keys()
    code, _, err = told("bag", str(logged.path), "--out", str(tmp_path / "b"))
    assert code == 2 and "is there already: name another folder, or remove it" in err


def test_of_a_damaged_log_what_is_whole_is_written_and_the_rest_named(logged: Logged, tmp_path: Path) -> None:
    parts = records(logged.path.read_bytes())
    damaged = bytearray(written(parts, chunk_size=4000))
    damaged[len(damaged) // 3] ^= 0xFF
    path = tmp_path / "log.mcap"
    path.write_bytes(damaged)
    left = read_log(path)
    assert left.damage and 0 < len(left.topic("/controller")) < len(logged.log.topic("/controller"))
    code, _, err = told("foxglove", str(path), "--out", str(tmp_path / "f.mcap"))
    assert code == 2 and "are left out" in err
    assert len(decoded(tmp_path / "f.mcap")["/run"]) == len(left.topic("/controller"))
    code, _, err = told("bag", str(path), "--out", str(tmp_path / "b"))
    assert code == 2 and "are left out" in err
    assert len(decoded(next((tmp_path / "b").glob("*.mcap")))["/log/controller"]) == len(left.topic("/controller"))


def test_a_log_without_targets_still_gives_its_own_topics(logged: Logged, tmp_path: Path) -> None:
    parts = records(logged.path.read_bytes())
    target = next(part.id for part in parts if getattr(part, "topic", "") == "/target")
    parts = [part for part in parts if not (isinstance(part, Message) and part.channel_id == target)]
    (tmp_path / "log.mcap").write_bytes(written(parts))
    for command, name in (("foxglove", "f.mcap"), ("bag", "b")):
        code, _, err = told(command, str(tmp_path / "log.mcap"), "--out", str(tmp_path / name))
        assert code == 2 and "the arm, its tip and target are left out: the log has no messages of /target" in err
    assert "/log/controller" in decoded(tmp_path / "f.mcap")
    assert "/body1" in decoded(next((tmp_path / "b").glob("*.mcap")))


def test_a_type_that_ros_has_not_is_left_out_of_the_bag(logged: Logged, tmp_path: Path) -> None:
    parts = records(logged.path.read_bytes())
    next(part for part in parts if isinstance(part, Schema) and part.name.endswith("/Timing")).name = "apcc_torch/msg/'"
    (tmp_path / "log.mcap").write_bytes(written(parts))
    code, _, err = told("bag", str(tmp_path / "log.mcap"), "--out", str(tmp_path / "b"))
    assert code == 2 and "/log/timing has no type of ROS 2" in err
    topics = decoded(next((tmp_path / "b").glob("*.mcap")))
    assert "/log/timing" not in topics and "/log/controller" in topics


def test_what_dates_a_log_may_be_lost(logged: Logged) -> None:
    log = logged.log
    began, without = log.began, dict(log.topics)
    del without["/start"]
    again = RobotLog({}, {}, without, [], True, [], log.stamps, log.layouts)
    assert abs(again.began - began) < 1000, "to what a float64 of seconds holds, ns"
    with pytest.raises(DataError, match="nobody knows when its time began"):
        _ = RobotLog({}, {}, {}, [], True).began


def test_a_folder_that_cannot_be_written_is_left_as_it_was(logged: Logged, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteError, match="cannot be written"):
        write_bag(logged.log, tmp_path / "file" / "bag")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
