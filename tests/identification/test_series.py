"""Recordings as fits take them: read, checked, and their past."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.identification.series import Series, read_series

GOOD = "t,label,a,b,x,y,z\n10.0,go,1,2,100,0,5\n10.5,go_hold,2,2,110,0,5\n11.0,back,3,2,120,0,5\n"


def _read(tmp_path: Path, text: str, bodies: tuple[tuple[str, ...], ...] = (("x", "y", "z"),)) -> Series:
    path = tmp_path / "r.csv"
    path.write_text(text)
    return read_series(path, ["a", "b"], bodies, unit=1e-3, time="t", group="label", group_ending="_hold")


def test_a_table_is_read_in_its_units(tmp_path: Path) -> None:
    series = _read(tmp_path, GOOD)
    assert series.times.tolist() == [0.0, 0.5, 1.0]
    assert series.inputs.tolist() == [[1, 2], [2, 2], [3, 2]]
    assert series.positions[1, 0].tolist() == pytest.approx([0.11, 0.0, 0.005])
    assert series.groups.tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("t,label", "t,word", "column 'label': the column is missing"),
        (",a,", ",q,", "column 'a': the column is missing"),
        ("110,0,5", "left,0,5", "column 'x', line 3: 'left' is not a number"),
        ("110,0,5", "inf,0,5", "column 'x', line 3: the cell holds no finite number"),
        ("11.0,back", "9.0,back", "column 't', line 4: the time goes backward"),
        ("2,110,0,5", "2,110,0", "line 3: the line has 6 cells"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(DataError, match=words) as caught:
        _read(tmp_path, GOOD.replace(old, new))
    assert "\n" not in str(caught.value)


def test_missing_files_and_bodies_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nothing\.csv cannot be read"):
        read_series(tmp_path / "nothing.csv", ["a"], [["x", "y", "z"]])
    with pytest.raises(ConfigError, match="three columns a body"):
        _read(tmp_path, GOOD, (("x", "y"),))


def test_history_looks_back_only_and_slides_follow_the_motion() -> None:
    inputs = torch.tensor([[0.0], [1.0], [2.0], [1.9], [1.0]], dtype=torch.float64)
    nothing = torch.zeros(5, 1, 3, dtype=torch.float64)
    series = Series(torch.arange(5).double(), inputs, nothing, torch.zeros(5, dtype=torch.int64))
    drive = series.drive(history=3, travel=0.4)
    assert drive.history[..., 0].tolist() == [[0, 0, 0], [1, 0, 0], [2, 1, 0], [1.9, 2, 1], [1, 1.9, 2]]
    assert drive.ages[4].tolist() == [0, 1, 2]
    assert drive.ages[0].tolist() == [0, 0, 0]
    assert drive.slide[:, 0].tolist() == pytest.approx([0.0, 1.0, 1.0, 0.5, -1.0])
    assert not bool(series.drive().slide.any())
