"""Recordings: round trips, rotations against scipy, and every kind of damaged file named by file, column and line."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

from apcc_torch.errors import ApccError, ConfigError, DataError, ShapeError, ValueRangeError
from apcc_torch.lie.rotations import quaternion_rotation
from apcc_torch.recordings.recording import Recording, save_recording
from apcc_torch.recordings.recording_file import load_recording
from apcc_torch.recordings.rest_pose import calibrate
from laws import check_batching, generator, normal


def make_recording(frames: int = 5) -> Recording:
    rng = generator(3)
    tracked = torch.ones(frames, 2, dtype=torch.bool)
    position = normal((frames, 2, 3), torch.float64, rng)
    tracked[1, 0], position[1, 0] = False, torch.nan
    return Recording(
        ("low", "the_tip"),
        torch.arange(frames, dtype=torch.float64) / 7,
        position,
        torch.nn.functional.normalize(normal((frames, 2, 4), torch.float64, rng), dim=-1),
        tracked,
        normal((frames, 3), torch.float64, rng),
        normal((frames, 4), torch.float64, rng),
        normal((frames, 3), torch.float64, rng),
    )


def test_what_is_saved_is_loaded_exactly(tmp_path: Path) -> None:
    recording = make_recording()
    save_recording(recording, tmp_path / "recording.csv")
    for path in (tmp_path, tmp_path / "recording.csv"):
        have = load_recording(path)
        assert have.names == recording.names and have.source == str(tmp_path / "recording.csv")
        for field in dataclasses.fields(recording):
            want = getattr(recording, field.name)
            if isinstance(want, torch.Tensor):
                torch.testing.assert_close(getattr(have, field.name), want, rtol=0, atol=0, equal_nan=True)
    assert [p.name for p in tmp_path.iterdir()] == ["recording.csv"]


def test_names_of_bodies_are_no_formulas(tmp_path: Path) -> None:
    recording = dataclasses.replace(make_recording(), names=("=cmd|'/C calc'!A0", "the tip"))
    save_recording(recording, tmp_path / "recording.csv")
    assert (tmp_path / "recording.csv").read_text().startswith("time,'=cmd|'/C calc'!A0_x,")
    assert load_recording(tmp_path).names == ("'=cmd|'/C calc'!A0", "the tip")


def test_only_time_and_one_body_are_needed(tmp_path: Path) -> None:
    bare = dataclasses.replace(make_recording(), inputs=None, actuators=None, target=None)
    path = tmp_path / "own.csv"
    save_recording(bare, path)
    lines = [line.split(",") for line in path.read_text().splitlines()]
    keep = [i for i, c in enumerate(lines[0]) if c == "time" or (c.startswith("the_tip") and "tracked" not in c)]
    path.write_text("\r\n".join(",".join(line[i] for i in keep[::-1]) for line in lines) + "\r\n\r\n")
    have = load_recording(path)
    assert have.names == ("the_tip",) and have.inputs is None and have.target is None and bool(have.tracked.all())
    assert torch.equal(have.position, bare.position[:, 1:]) and torch.equal(have.quaternion, bare.quaternion[:, 1:])


def test_a_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    path, recording = tmp_path / "r.csv", make_recording()
    save_recording(recording, path)
    before = path.read_bytes()
    with pytest.raises(DataError, match=r"frame 1 of body 'low'"):
        save_recording(dataclasses.replace(recording, tracked=torch.ones(5, 2, dtype=torch.bool)), path)
    with pytest.raises(DataError, match="inputs is not finite"):
        save_recording(dataclasses.replace(recording, inputs=torch.full((5, 1), torch.inf)), path)
    assert path.read_bytes() == before


def test_rotations_are_scipys() -> None:
    recording = make_recording()
    want = Rotation.from_quat(recording.quaternion.reshape(-1, 4).numpy()).as_matrix().reshape(5, 2, 3, 3)
    torch.testing.assert_close(recording.rotation, torch.from_numpy(want))
    # The length is not lost: a quaternion that is not unit shows in the matrix.
    q = recording.quaternion[0, 0]
    torch.testing.assert_close(quaternion_rotation(2 * q), 4 * quaternion_rotation(q))
    assert torch.equal(quaternion_rotation(0 * q), torch.zeros(3, 3, dtype=torch.float64))
    check_batching(quaternion_rotation, lambda shape, dtype, rng: (normal((*shape, 4), dtype, rng),))


def cell(text: str, line: int, column: str, value: str) -> str:
    """The CSV text with one cell changed; lines count from 1, the header's."""
    lines = [row.split(",") for row in text.splitlines()]
    lines[line - 1][lines[0].index(column)] = value
    return "\n".join(",".join(row) for row in lines) + "\n"


DAMAGE = {
    "missing column": (lambda t: cell(t, 1, "low_qy", "low_odd"), "column 'low_qy': the column is missing"),
    "missing input": (lambda t: cell(t, 1, "u2", "v2"), "column 'u2': the column is missing"),
    "repeated column": (lambda t: cell(t, 1, "u3", "u1"), "column 'u1': the column is there more than once"),
    "text": (lambda t: cell(t, 4, "u3", "fast"), "column 'u3', line 4: 'fast' is not a number"),
    "empty": (lambda t: cell(t, 4, "the_tip_z", ""), "column 'the_tip_z', line 4: the cell holds no finite number"),
    "infinite": (lambda t: cell(t, 5, "u1", "inf"), "column 'u1', line 5: the cell holds no finite number"),
    "length": (
        lambda t: cell(t, 6, "low_qx", "3"),
        "column 'low_qx', line 6: the quaternion that begins here has length",
    ),
    "flag": (lambda t: cell(t, 2, "low_tracked", "2"), "column 'low_tracked', line 2: the cell must be 0 or 1"),
    "time": (lambda t: cell(t, 4, "time", "0"), "column 'time', line 4: the time goes backward"),
    "truncated": (lambda t: t[: t.rstrip().rindex(",")], "line 6: the line has 26 cells where the header has 27"),
    "no data": (lambda t: t.splitlines()[0] + "\n", "holds no data lines"),
    "nothing": (lambda t: "", "holds no data lines"),
    "no body": (lambda t: "time,u1\n0,1\n", "no body has a position"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_named_in_one_sentence(kind: str, tmp_path: Path) -> None:
    damage, message = DAMAGE[kind]
    path = tmp_path / "r.csv"
    save_recording(make_recording(), path)
    path.write_text(damage(path.read_text()))
    with pytest.raises(DataError, match=re.escape(message)) as caught:
        load_recording(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_files_that_are_not_there_or_not_text(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"recording\.csv cannot be read"):
        load_recording(tmp_path)
    (tmp_path / "recording.csv").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(DataError, match="it is not UTF-8"):
        load_recording(tmp_path)
    with pytest.raises(DataError, match="0 files"):
        load_recording(tmp_path, layout="trunk")
    with pytest.raises(ConfigError, match="layout must be one of auto, table, trunk"):
        load_recording(tmp_path, layout="other")
    with pytest.raises(ValueRangeError, match="rate"):
        load_recording(tmp_path, layout="trunk", rate=0.0)


def test_stamps_that_cannot_tell_frames_apart_are_refused() -> None:
    place, turn = torch.zeros(3, 1, 3), torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(3, 1, 4)
    epoch = 1.7e9 + torch.arange(3, dtype=torch.float64) / 100
    Recording(("tip",), epoch, place, turn, torch.ones(3, 1).bool())
    with pytest.raises(ValueRangeError, match=r"times is torch.float32, which has steps of 128 s at 1.7e\+09 s"):
        Recording(("tip",), epoch.float(), place, turn, torch.ones(3, 1).bool())


def test_a_recording_checks_its_shapes() -> None:
    good = make_recording()
    bad: list[tuple[str, object, type[ApccError]]] = [
        ("position", good.position[:4], ShapeError),
        ("quaternion", good.position, ShapeError),
        ("tracked", good.tracked.double(), ShapeError),
        ("inputs", good.inputs[:2] if good.inputs is not None else None, ShapeError),
        ("names", ("a,b", "c"), DataError),
        ("names", ("target", "c"), DataError),
    ]
    for name, value, error in bad:
        with pytest.raises(error, match=name):
            dataclasses.replace(good, **{name: value})


def write_trunk(folder: Path, frames: int = 4, commands: int = 3) -> None:
    parts = [f"{c}{i}" for i in (1, 2) for c in "xyz"] + [f"{c}{i}" for i in (1, 2) for c in ("qx", "qy", "qz", "w")]
    pose = "1,2,3,4,5,6,0.6,0,0,0.8,0,0,0,1"
    rows = [f"{i},{pose},{i}.5" for i in range(frames)]
    (folder / "observations_a_1.csv").write_text("\n".join([",".join(["ID", *parts, "phi1"]), *rows]) + "\n")
    rows = [f"{i},{10 * i},0" for i in range(commands)]
    (folder / "control_inputs_a_1.csv").write_text("\n".join(["ID,u1,u2", *rows]) + "\n")


def test_the_trunk_layout(tmp_path: Path) -> None:
    write_trunk(tmp_path)
    for path in (tmp_path, tmp_path / "observations_a_1.csv"):
        r = load_recording(path, layout="trunk", rate=50.0)
        assert len(r) == 3 and r.names == ("disk1", "disk2")
        assert r.times.tolist() == [0.0, 0.02, 0.04]
        assert r.position[2].tolist() == [[1, 2, 3], [4, 5, 6]]
        assert r.quaternion[0].tolist() == [[0.6, 0, 0, 0.8], [0, 0, 0, 1]]
        assert r.inputs is not None and r.inputs[2].tolist() == [20, 0]
        assert r.actuators is not None and r.actuators[:, 0].tolist() == [0.5, 1.5, 2.5]
    (tmp_path / "control_inputs_a_1.csv").unlink()
    alone = load_recording(tmp_path, layout="trunk")
    assert len(alone) == 4 and alone.inputs is None


def test_positions_alone_are_a_recording(tmp_path: Path) -> None:
    (tmp_path / "observations_p.csv").write_text("ID,x1,y1,z1,phi1\n0,1,2,3,0.5\n1,1,2,4,0.6\n")
    r = load_recording(tmp_path, layout="trunk")
    assert r.position[:, 0].tolist() == [[1, 2, 3], [1, 2, 4]]
    assert bool(r.quaternion.isnan().all()) and bool(r.rotation.isnan().all())
    found = calibrate(r, rest=2, base_position=[1.0, 2.0, 0.0], direction=[0.0, 0.0, 1.0])
    assert found.abscissae.tolist() == [3.5] and bool(found.mount_rotation.isfinite().all())
    (tmp_path / "observations_p.csv").write_text("ID,x1,y1,z1,qx1\n0,1,2,3,0.5\n")
    with pytest.raises(DataError, match="column 'qy1': the column is missing"):
        load_recording(tmp_path, layout="trunk")


@pytest.mark.parametrize(("frames", "commands"), [(4, 2), (4, 5)])
def test_the_trunk_files_must_agree_in_length(frames: int, commands: int, tmp_path: Path) -> None:
    write_trunk(tmp_path, frames, commands)
    with pytest.raises(DataError, match=rf"control_inputs_a_1.*holds {commands} data lines where .* holds {frames}"):
        load_recording(tmp_path, layout="trunk")


def test_a_line_missing_from_the_middle_is_named(tmp_path: Path) -> None:
    write_trunk(tmp_path)
    path = tmp_path / "observations_a_1.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:2] + lines[3:]) + "\n")
    with pytest.raises(DataError, match="column 'ID', line 3"):
        load_recording(tmp_path, layout="trunk")


def test_the_recorded_trunk(shared_data: Path, tmp_path: Path) -> None:
    r = load_recording(shared_data / "trunk", layout="trunk")
    assert len(r) == 6000 and r.names == ("disk1", "disk2", "disk3")
    assert r.inputs is not None and r.inputs.shape == (6000, 6)
    assert r.actuators is not None and r.actuators.shape == (6000, 6)
    save_recording(r, tmp_path / "own.csv")
    again = load_recording(tmp_path / "own.csv")
    assert torch.equal(again.position, r.position) and torch.equal(again.quaternion, r.quaternion)
