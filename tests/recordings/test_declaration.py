"""What is declared of a recording, what is told by its file, and what is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from apcc_torch.errors import ApccError, ConfigError, DataError
from apcc_torch.recordings.declaration import RecordingSettings
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.recording_file import load_recording

BODY = "t,x1,y1,z1\n0,1,2,3\n1,1,2,4\n"


def read(folder: Path, text: str, **declared: object) -> Recording:
    path = folder / "r.csv"
    path.write_text(text)
    return load_recording(path, **declared)


@pytest.mark.parametrize(
    ("header", "names", "position"),
    [
        ("time,x,y,z", ("tip",), [1.0, 2.0, 3.0]),
        ("time,pos_x,pos_y,pos_z", ("tip",), [1.0, 2.0, 3.0]),
        ("Time (Seconds),x1 [mm],y1 [mm],z1 [mm]", ("1",), [1e-3, 2e-3, 3e-3]),
        ("Timestamp,tip_x_cm,tip_y_cm,tip_z_cm", ("tip",), [0.01, 0.02, 0.03]),
        ("%time,field.pose.position.x,field.pose.position.y,field.pose.position.z", ("field",), [1.0, 2.0, 3.0]),
        ("header.stamp.sec,tip/pose/position/x,tip/pose/position/y,tip/pose/position/z", ("tip",), [1.0, 2.0, 3.0]),
        ("t_ms,X_tip,Y_tip,Z_tip", ("tip",), [1.0, 2.0, 3.0]),
        ("t,tip X,tip Y,tip Z", ("tip",), [1.0, 2.0, 3.0]),
    ],
)
def test_names_of_columns_tell_what_they_hold(
    header: str, names: tuple[str, ...], position: list[float], tmp_path: Path
) -> None:
    found = read(tmp_path, f"{header}\n0,1,2,3\n1,1,2,3\n")
    assert found.names == names and found.position[0, 0].tolist() == pytest.approx(position)
    step = {"t_ms": 1e-3, "%time": 1e-9}.get(header.split(",")[0], 1.0)
    assert float(found.times[1] - found.times[0]) == pytest.approx(step)


def test_stamps_of_two_columns(tmp_path: Path) -> None:
    text = "header.stamp.sec,header.stamp.nanosec,x1,y1,z1,battery\n5,500000000,1,2,3,full\n6,0,1,2,3,full\n"
    assert read(tmp_path, text).times.tolist() == [5.5, 6.0]


def test_orientation_by_angles_and_offsets_that_turn(tmp_path: Path) -> None:
    text = "t,a_x,a_y,a_z,a_rx,a_ry,a_rz\n0,1,2,3,30,20,10\n"
    found = read(tmp_path, text, euler="{body}_r{axis}", euler_order="zyx", offsets=[[0.0, 0.1, 0.0]])
    turn = Rotation.from_euler("ZYX", [30, 20, 10], degrees=True)
    torch.testing.assert_close(found.rotation[0, 0], torch.from_numpy(turn.as_matrix()))
    assert found.position[0, 0].tolist() == pytest.approx((turn.apply([0, 0.1, 0]) + np.arange(1, 4)).tolist())
    radians = read(tmp_path, text.replace("30,20,10", "0.3,0.2,0.1"), euler="{body}_r{axis}", angle="rad")
    told = Rotation.from_quat(radians.quaternion[0, 0].numpy()).as_euler("XYZ")
    assert told.tolist() == pytest.approx([0.3, 0.2, 0.1])
    with pytest.raises(ConfigError, match="offsets turn with their bodies"):
        read(tmp_path, BODY, offsets=[[0.0, 0.1, 0.0]])


def test_the_target_is_in_the_same_frame(tmp_path: Path) -> None:
    found = read(tmp_path, "t,a_x,a_y,a_z,target_x,target_y,target_z\n0,1,2,3,4,5,6\n", unit="mm", up="y")
    assert found.target is not None and found.target[0].tolist() == pytest.approx([4e-3, -6e-3, 5e-3])


@pytest.mark.parametrize(
    ("text", "declared", "words"),
    [
        ("1,2,3\n4,5,6\n", {}, "line 1: holds numbers where the names of the columns are wanted"),
        ("t;x1;y1;z1\n0;1,5;2;3\n", {"decimal": "."}, "line 2: '1,5' is not a number; write recording.decimal: ','"),
        ("t;x1;y1;z1\n0;1.5;2;3\n", {"decimal": ","}, "column 'x1', line 2: '1.5' is not a number"),
        ("t,x1,y1,z1\n0,1,2,3\n10,1,2,3\n20,1,2,3\n", {}, "column 't': steps are 10 long, hardly seconds: "),
        ("t,a_q,b\n0,1,2\n", {}, "no body has a position"),
        (BODY, {"position": "rb_{body}_x"}, "recording.bodies must name the bodies"),
        (BODY, {"bodies": ["2"]}, "has no body '2'"),
        (BODY, {"position": "x{body}", "bodies": ["7"]}, "column 'x7': the column is missing"),
        (BODY, {"inputs": ["m*"]}, "recording.inputs: nothing is called m*; there are t, x1, y1, z1"),
        (BODY, {"inputs": ["m1"]}, "column 'm1': the column is missing"),
        ("t,a_x,a_y,a_z,a_q0,a_q1,a_q2,a_q3\n0,1,2,3,1,0,0,0\n", {}, "recording.quaternion_order must be given"),
        ("t,x1,y1,z1\n0,,,\n1,,,\n", {}, "'1' was never tracked"),
    ],
)
def test_what_cannot_be_read_is_named(text: str, declared: dict[str, object], words: str, tmp_path: Path) -> None:
    with pytest.raises(ApccError) as caught:
        read(tmp_path, text, **declared)
    assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("declared", "words"),
    [
        ({"unit": "furlong"}, "unit must be one of m, dm, cm"),
        ({"unit": 0.0}, "unit must be zero or positive|unit must be positive"),
        ({"bodies": [["x", "y"]]}, "bodies must be names, or three columns a body"),
        ({"bodies": ["a", ["x", "y", "z"]]}, "bodies must all be names"),
        ({"delimiter": "both"}, "delimiter must be a character, tab or blank"),
        ({"position": "body_{body}_pos"}, "position must say where the axis stands"),
        ({"euler": "r{axis}", "quaternion": "q{axis}"}, "euler must be empty"),
        ({"up": "north"}, "up must be one of x, y, z"),
    ],
)
def test_declarations_without_a_meaning_are_refused(declared: dict[str, object], words: str) -> None:
    with pytest.raises(ApccError, match=words):
        RecordingSettings(**declared)  # type: ignore[arg-type]


def test_a_comment_may_name_the_columns(tmp_path: Path) -> None:
    found = read(tmp_path, "# made by numpy\n# t, x1, y1, z1\n0.0, 1.0, 2.0, 3.0\n1.0, 1.0, 2.0, 4.0\n")
    assert len(found) == 2 and found.position[1, 0].tolist() == [1.0, 2.0, 4.0]


def test_frames_are_counted_at_a_rate(tmp_path: Path) -> None:
    text = "Frame,x1,y1,z1\n100,1,2,3\n102,1,2,3\n"
    assert read(tmp_path, text, time_unit="frames", rate=50.0).times.tolist() == [2.0, 2.04]
    assert read(tmp_path, text, rate=50.0).times.tolist() == [0.0, 0.02]
    with pytest.raises(DataError, match="more than once"):
        read(tmp_path, "t,x1,x1,y1,z1\n0,1,1,2,3\n")
