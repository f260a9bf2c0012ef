"""A recording in any layout that a lab may choose, declared as it is, is read back with the same numbers."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from apcc_torch.errors import DataError
from apcc_torch.lie.rotations import quaternion_rotation
from apcc_torch.recordings.recording_file import load_recording
from made_recordings import METRES, NAMES, SECONDS, Layout, arm_of, recorded, write

UPS = ("x", "y", "z", "-x", "-y", "-z")


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    delimiter = draw(st.sampled_from([",", ";", "\t", "|", ""]))
    style = draw(st.sampled_from(sorted(NAMES)))
    return Layout(
        style=style,
        unit=draw(st.sampled_from(sorted(METRES))),
        order=draw(st.sampled_from(["xyzw", "wxyz"])),
        up=draw(st.sampled_from(UPS)),
        hand=draw(st.sampled_from(["right", "left"])),
        delimiter=delimiter,
        decimal=draw(st.sampled_from([".", ","])),
        bom=draw(st.booleans()),
        time_unit=draw(st.sampled_from(sorted(SECONDS))),
        comments=draw(st.booleans()),
        quaternions=draw(st.booleans()),
        shuffled=draw(st.integers(0, 5)),
    )


@settings(max_examples=12)
@given(
    layout=layouts(),
    size=st.floats(0.06, 3.0),
    sections=st.integers(2, 4),
    dropped=st.sampled_from([0.0, 0.2]),
    seed=st.integers(0, 2**31),
)
def test_what_is_declared_as_it_is_comes_back(
    layout: Layout, size: float, sections: int, dropped: float, seed: int
) -> None:
    arm = arm_of(size, sections)
    truth = recorded(arm, dropped=dropped, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        path = write(truth, Path(folder) / "r.csv", layout)
        read = load_recording(path, arm=arm, **layout.declared(truth.names))
    assert torch.equal(read.tracked, truth.tracked)
    torch.testing.assert_close(read.times, truth.times)
    assert read.inputs is not None and truth.inputs is not None
    torch.testing.assert_close(read.inputs, truth.inputs)
    torch.testing.assert_close(read.position, truth.position, rtol=0, atol=1e-9, equal_nan=True)
    if layout.quaternions:
        # A quaternion and its negative are one rotation.
        seen = truth.tracked
        torch.testing.assert_close(
            quaternion_rotation(read.quaternion)[seen], quaternion_rotation(truth.quaternion)[seen], rtol=0, atol=1e-9
        )
    else:
        assert bool(read.quaternion.isnan().all())


@settings(max_examples=12)
@given(
    size=st.floats(0.06, 3.0),
    sections=st.integers(2, 4),
    written=st.sampled_from(["m", "cm", "mm"]),
    declared=st.sampled_from(["m", "cm", "mm"]),
    seed=st.integers(0, 2**31),
)
def test_a_wrong_unit_is_named(size: float, sections: int, written: str, declared: str, seed: int) -> None:
    arm = arm_of(size, sections)
    with tempfile.TemporaryDirectory() as folder:
        path = write(recorded(arm, dropped=0.2, seed=seed), Path(folder) / "r.csv", Layout(unit=written))
        if written == declared:
            load_recording(path, arm=arm, unit=declared)
            return
        with pytest.raises(DataError, match=rf"write recording\.unit: {written}$"):
            load_recording(path, arm=arm, unit=declared)


@settings(max_examples=12)
@given(size=st.floats(0.06, 3.0), up=st.sampled_from(UPS), seed=st.integers(0, 2**31), turns=st.booleans())
def test_a_wrong_way_up_is_named(size: float, up: str, seed: int, turns: bool) -> None:
    arm = arm_of(size)
    with tempfile.TemporaryDirectory() as folder:
        path = write(recorded(arm, dropped=0.2, seed=seed), Path(folder) / "r.csv", Layout(up=up, quaternions=turns))
        if up == "z":
            load_recording(path, arm=arm)
            return
        with pytest.raises(DataError, match=rf"recording\.up: {up}\b"):
            load_recording(path, arm=arm)


@settings(max_examples=12)
@given(size=st.floats(0.06, 3.0), seed=st.integers(0, 2**31), up=st.sampled_from(UPS))
def test_a_wrong_order_of_quaternions_is_named(size: float, seed: int, up: str) -> None:
    arm = arm_of(size)
    truth = recorded(arm, dropped=0.2, seed=seed)
    # The columns are called x, y, z, w, and hold w, x, y, z.
    with tempfile.TemporaryDirectory() as folder:
        path = write(truth, Path(folder) / "r.csv", Layout(order="wxyz", up=up))
        text = path.read_text()
        for name in truth.names:
            for old, new in zip("wxyz", "xyzw", strict=True):
                text = text.replace(f"{name}_q{old}", f"{name}_Q{new}")
        path.write_text(text.replace("_Q", "_q"))
        with pytest.raises(DataError, match=r"write recording\.quaternion_order: wxyz$"):
            load_recording(path, arm=arm, up=up)
        right = load_recording(path, arm=arm, up=up, quaternion_order="wxyz")
    torch.testing.assert_close(right.quaternion.abs(), truth.quaternion.abs(), rtol=0, atol=1e-9, equal_nan=True)
