"""Sessions of several files: motors in another one, rest and validation, labels, and what is left out of a fit."""

from __future__ import annotations

from pathlib import Path

import pytest

from apcc_torch.composition.evaluate import recordings
from apcc_torch.composition.identify import recorded
from apcc_torch.errors import ConfigError, DataError
from apcc_torch.recordings.data_set import DataSettings, SessionSettings
from apcc_torch.recordings.declaration import RecordingSettings
from apcc_torch.recordings.recording_file import load_recording
from apcc_torch.recordings.session_file import load_rest, load_session
from composed import composed_evaluate, composed_identify
from made_recordings import Layout, arm_of, write
from made_recordings import recorded as made

READ = RecordingSettings()


def still_then_moving(folder: Path, still: int = 15) -> Path:
    """A file without inputs, whose arm does not move at first; a second one has its motors, at other times."""
    lines = ["t,x1,y1,z1,x2,y2,z2"]
    for i in range(40):
        x = 0.001 * max(i - still, 0)
        lines.append(f"{0.1 * i},{x},0,-0.1,{2 * x},0,-0.2")
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    motors = [f"{0.05 + 0.2 * i},{i},{-i}" for i in range(19)]
    (folder / "motors.csv").write_text("\n".join(["time,m1,m2", *motors]) + "\n")
    return folder


def test_motors_from_another_file_hold_until_the_next(tmp_path: Path) -> None:
    still_then_moving(tmp_path)
    session = SessionSettings(file="poses.csv", inputs="motors.csv")
    found = load_session(tmp_path, session, READ)
    assert len(found) == 39 and found.inputs is not None and found.inputs[:4, 0].tolist() == [0, 0, 1, 1]
    assert load_session(tmp_path, session, RecordingSettings(inputs=["m2"])).inputs[3].tolist() == [-1]  # type: ignore[index]
    (tmp_path / "motors.csv").write_text("m1\n1\n2\n")
    with pytest.raises(DataError, match=r"motors\.csv: has no time, and 2 lines for 40 frames"):
        load_session(tmp_path, session, READ)
    (tmp_path / "motors.csv").write_text("t,m1\n99,1\n")
    with pytest.raises(DataError, match="both must have one clock"):
        load_session(tmp_path, session, READ)


def test_the_rest_from_stillness_and_from_another_file(tmp_path: Path) -> None:
    still_then_moving(tmp_path)
    sessions = {"one": SessionSettings(file="poses.csv")}
    still = load_rest(tmp_path, DataSettings(sessions=sessions, rest="still"), READ)
    assert still is not None and len(still) == 16  # the first step of the motion is below what counts
    other = load_rest(tmp_path, DataSettings(sessions=sessions, rest="poses.csv", rest_frames=5), READ)
    assert other is not None and len(other) == 5
    assert load_rest(tmp_path, DataSettings(sessions=sessions), READ) is None


def data_file(folder: Path, more: str = "") -> Path:
    arm = arm_of(0.2, 2)
    for name, seed in (("first", 1), ("second", 2)):
        write(made(arm, dropped=0.1, seed=seed), folder / f"{name}.csv", Layout(unit="mm"))
    (folder / "arm.yaml").write_text(
        "lengths: [0.1, 0.1]\nmass: 0.1\ntendons: {angles: [0, 1.5708], offsets: 0.004, ends: [2, 2]}\n"
    )
    path = folder / "mine.yaml"
    path.write_text(
        "data: {arm: arm.yaml, sessions: {a: {file: first.csv, payload: 0.0}, b: {file: second.csv}}" + more + "}\n"
        "recording: {unit: mm}\nevery: 2\n"
    )
    return path


def test_one_data_file_for_both_programs_and_dropouts_left_out(tmp_path: Path) -> None:
    path = data_file(tmp_path)
    series, parts = recorded(composed_identify(f"data={path}"))
    assert 0 < int((~series.seen).sum()) < len(series) // 2
    for index in parts:
        assert bool(series.seen[index].all()) and len(index)
    # Dropouts leave the inputs' past whole.
    assert series.drive(3).history.shape == (60, 3, 2)
    sessions, rest = recordings(composed_evaluate(f"data={path}"))
    assert [s.name for s in sessions] == ["a", "b"] and rest is None and sessions[0].payload == 0.0
    assert bool(sessions[1].frames.at(sessions[1].folds[0].validation).positions.isfinite().all())


def test_a_file_for_validation(tmp_path: Path) -> None:
    path = data_file(tmp_path, ", validation: b")
    series, parts = recorded(composed_identify(f"data={path}"))
    assert len(series) == 120 and int(parts.training.max()) < 60 <= int(parts.validation.min())
    sessions, _ = recordings(composed_evaluate(f"data={path}"))
    assert [(len(s.folds[0].training) > 0, len(s.folds[0].validation) > 0) for s in sessions] == [
        (True, False),
        (False, True),
    ]
    for wrong in (", validation: c", ", validation: a"):
        with pytest.raises(ConfigError, match=r"data\.validation must name"):
            composed_identify(f"data={data_file(tmp_path, wrong)}")


def test_a_bad_file_harms_itself_alone(tmp_path: Path) -> None:
    path = data_file(tmp_path)
    second = tmp_path / "second.csv"
    second.write_text(second.read_text()[:200])
    told: dict[str, DataError] = {}
    sessions, _ = recordings(composed_evaluate(f"data={path}"), told.__setitem__)
    assert [s.name for s in sessions] == ["a"] and str(told["b"]).startswith(str(second))
    with pytest.raises(DataError, match=r"second\.csv"):
        recordings(composed_evaluate(f"data={path}", "data.train=b"), told.__setitem__)


def test_columns_that_are_left_are_the_inputs_where_the_arm_has_so_many(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    lines = ["t,left,right,x1,y1,z1,x2,y2,z2"] + [f"{i},{i},{-i},0,0,-0.1,0,{0.001 * i},-0.2" for i in range(9)]
    path.write_text("\n".join(lines) + "\n")
    arm = arm_of(0.2, 2)
    assert load_recording(path, arm=arm, time_unit="s").inputs is None  # it has six
    two = arm.changed(tendons=arm.tendons.changed(angles=[0.0, 1.0], offsets=0.004, ends=[2, 2]))
    assert load_recording(path, arm=two).inputs.tolist()[3] == [3.0, -3.0]  # type: ignore[union-attr]


@pytest.mark.parametrize("program", ["identify", "evaluate"])
def test_a_wrong_unit_is_named_by_the_programs(program: str, tmp_path: Path) -> None:
    path = data_file(tmp_path)
    path.write_text(path.read_text().replace("unit: mm", "unit: cm"))
    begin = {
        "identify": lambda: recorded(composed_identify(f"data={path}")),
        "evaluate": lambda: recordings(composed_evaluate(f"data={path}")),
    }[program]
    with pytest.raises(DataError, match=r"first\.csv: the bodies lie [19][\d.]* times as far apart .*unit: mm"):
        begin()
