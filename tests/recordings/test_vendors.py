"""Exports of motion-capture programs, as those programs lay them out."""

from __future__ import annotations

import math
import random
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

from apcc_torch.errors import ApccError, DataError
from apcc_torch.recordings.recording_file import load_recording
from apcc_torch.recordings.vendors import vendor_of

HALF = math.sqrt(0.5)
ODD = ',;\t|"\n\r 0123456789.-eExyzqwNn#\x00é'
MOTIVE = """\
Format Version,1.23,Take Name,Take 1,Capture Frame Rate,120.000000,Export Frame Rate,50.000000,\
Rotation Type,Quaternion,Length Units,Millimeters,Coordinate Space,Global
,,,,,,,,,,,,,,,,,
,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body Marker,\
Rigid Body Marker,Rigid Body Marker,Rigid Body,Rigid Body,Rigid Body
,Name,low,low,low,low,low,low,low,low,low:Marker1,low:Marker1,low:Marker1,top,top,top
,ID,A,A,A,A,A,A,A,A,B,B,B,C,C,C
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position,Position,Position,\
Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z,X,Y,Z
"""
ROWS = [
    f"0,0.000,{HALF},0,0,{HALF},10,-100,5,0.1,1,2,3,20,-200,5",
    f"1,0.020,{HALF},0,0,{HALF},11,-100,5,0.1,1,2,3,,,",
]
SIX = """\
NO_OF_FRAMES\t2
NO_OF_CAMERAS\t4
NO_OF_BODIES\t2
FREQUENCY\t100
DESCRIPTION\t--
TIME_STAMP\t2020-01-22, 17:47:17\t22107.99
DATA_INCLUDED\t6D
BODY_NAMES\tlow\ttop
"""
THREE = """\
NO_OF_FRAMES\t2
NO_OF_MARKERS\t2
FREQUENCY\t200
DATA_INCLUDED\t3D
MARKER_NAMES\tlow\ttop
"""


def written(folder: Path, text: str, name: str = "take.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_motives_rigid_bodies(tmp_path: Path) -> None:
    path = written(tmp_path, MOTIVE + "\n".join(ROWS) + "\n")
    read = load_recording(path)
    assert read.names == ("low", "top") and read.times.tolist() == [0.0, 0.02]
    assert read.position[0].flatten().tolist() == pytest.approx([0.01, -0.1, 0.005, 0.02, -0.2, 0.005])
    assert read.tracked.tolist() == [[True, True], [True, False]]
    assert read.quaternion[0, 0].tolist() == pytest.approx([HALF, 0, 0, HALF])
    assert bool(read.quaternion[:, 1].isnan().all())
    upright = load_recording(path, up="y", bodies=["top", "low"])
    assert upright.names == ("top", "low")
    assert upright.position[0, 0].tolist() == pytest.approx([0.02, -0.005, -0.2])
    with pytest.raises(DataError, match=r"has no body 'lov'; did you mean low\?"):
        load_recording(path, bodies=["lov"])


def test_motives_angles(tmp_path: Path) -> None:
    text = MOTIVE.replace("Quaternion", "XYZ").replace(",X,Y,Z,W,X", ",X,Y,Z,,X") + "\n".join(ROWS) + "\n"
    path = written(tmp_path, text.replace(f"{HALF},0,0,{HALF}", "30,20,-10,"))
    want = torch.from_numpy(Rotation.from_euler("XYZ", [30, 20, -10], degrees=True).as_matrix())
    torch.testing.assert_close(load_recording(path).rotation[0, 0], want)


def six_rows(header: bool) -> str:
    """Roll of -0.6563 degrees, as Qualisys writes it: the matrix stands column by column."""
    wide = "X\tY\tZ\tRoll\tPitch\tYaw\tResidual\t" + "\t".join(f"Rot[{i}]" for i in range(9))
    names = f"Frame\tTime\tlow {wide}\ttop {wide}\n" if header else ""
    turn = "1.00000\t0.00099\t-0.00165\t-0.00101\t0.99993\t-0.01145\t0.00164\t0.01145\t0.99993"
    one = f"-194.9\t2.2\t0.9\t-0.65630\t0.09391\t0.05772\t4.9\t{turn}"
    lost = "0.000\t0.000\t0.000\t0.000\t0.000\t0.000\t-1.000" + "\t0.000" * 9
    return f"{SIX}{names}1\t0.00000\t{one}\t{one}\n2\t0.01000\t{one}\t{lost}\n"


@pytest.mark.parametrize("header", [True, False])
def test_qualisys_bodies(header: bool, tmp_path: Path) -> None:
    read = load_recording(written(tmp_path, six_rows(header), "take_6D.tsv"))
    assert read.names == ("low", "top") and read.times.tolist() == [0.0, 0.01]
    assert read.position[0, 0].tolist() == pytest.approx([-0.1949, 0.0022, 0.0009])
    assert read.tracked.tolist() == [[True, True], [True, False]]
    angles = Rotation.from_quat(read.quaternion[0, 0].numpy()).as_euler("XYZ", degrees=True)
    assert angles.tolist() == pytest.approx([-0.6563, 0.09391, 0.05772], abs=2e-3)


def test_qualisys_markers(tmp_path: Path) -> None:
    read = load_recording(written(tmp_path, THREE + "1\t2\t-3\t4\t5\t-6\n1\t2\t-3\t\t\t\n", "take.tsv"))
    assert read.names == ("low", "top") and read.times.tolist() == [0.0, 0.005]
    assert read.position[0].flatten().tolist() == pytest.approx([0.001, 0.002, -0.003, 0.004, 0.005, -0.006])
    assert read.tracked.tolist() == [[True, True], [True, False]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (MOTIVE.split("\n")[0], "no line begins with Frame"),
        (MOTIVE.replace("Position", "Place") + ROWS[0], "no lines of types, names and properties"),
        (MOTIVE + ROWS[0].replace("10,-100", "ten,-100"), "column 'low Position X', line 8: 'ten' is not a number"),
        (MOTIVE + "0,0.0,1", "line 8: the line has 3 cells where the header has 16"),
        (THREE + "1\t2\t3\n", "line 6: is not Qualisys' export, 2 bodies or markers do not fill the 3 cells"),
        (six_rows(True).replace("-194.9", "west", 1), "column 'low X', line 10: 'west' is not a number"),
        (SIX, "do not fill"),
    ],
)
def test_damaged_exports_are_named(text: str, words: str, tmp_path: Path) -> None:
    path = written(tmp_path, text)
    assert vendor_of(text) is not None
    with pytest.raises(DataError) as caught:
        load_recording(path)
    assert words in str(caught.value) and str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_what_is_damaged_is_read_or_refused_in_a_sentence(tmp_path: Path) -> None:
    rng = random.Random(3)
    texts = [MOTIVE + "\n".join(ROWS) + "\n", six_rows(True), THREE + "1\t2\t3\t4\t5\t6\n", "t,x1,y1,z1\n0,1,2,3\n"]
    refused = 0
    for _ in range(300):
        letters = list(rng.choice(texts))
        for _ in range(rng.choice([1, 3, 20])):
            k = rng.randrange(len(letters))
            letters[k : k + 1] = rng.choice([[], [rng.choice(ODD)], [letters[k], rng.choice(ODD)]])
        path = written(tmp_path, "".join(letters))
        try:
            load_recording(path)
        except ApccError as error:
            refused += 1
            told = str(error)
            assert "\n" not in told and len(told) < 2000
    assert refused > 100
