"""Recordings as bags: they come back as they were, whatever was tracked, sent and measured."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import DataError, WriteError
from apcc_torch.recordings.recording import Recording
from apcc_torch.recordings.recording_bag import save_bag
from apcc_torch.recordings.recording_file import load_recording
from laws import generator

rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed")


def recording(
    seed: int, T: int = 5, k: int = 2, inputs: int = 2, actuators: int = 0, target: bool = False
) -> Recording:
    rng = generator(seed)
    quaternion = torch.nn.functional.normalize(torch.randn(T, k, 4, generator=rng, dtype=torch.float64), dim=-1)
    times = 0.01 * torch.arange(T, dtype=torch.float64) + 3.0
    position = torch.randn(T, k, 3, generator=rng, dtype=torch.float64)
    tracked = torch.rand(T, k, generator=rng) < 0.8
    tracked[0] = True
    rows = [
        torch.randn(T, m, generator=rng, dtype=torch.float64) if m else None for m in (inputs, actuators, 3 * target)
    ]
    return Recording(tuple(f"disk_{i}" for i in range(k)), times, position, quaternion, tracked, *rows)


def same(read: Tensor | None, meant: Tensor | None) -> bool:
    return read is meant is None or (read is not None and meant is not None and bool((read == meant).all()))


@pytest.mark.parametrize(
    ("T", "k", "inputs", "actuators", "target"), [(2, 1, 0, 0, False), (7, 3, 2, 1, True), (4, 2, 0, 2, True)]
)
def test_it_comes_back(tmp_path: Path, T: int, k: int, inputs: int, actuators: int, target: bool) -> None:
    meant = recording(T, T, k, inputs, actuators, target)
    bag = save_bag(meant, tmp_path / "bag")
    read = load_recording(bag)
    assert read.names == tuple(f"/{name}" for name in meant.names)
    assert torch.allclose(read.times, meant.times, rtol=0.0, atol=1e-9)
    assert (read.tracked == meant.tracked).all() and not read.position[~read.tracked].isfinite().any()
    assert (read.position == meant.position)[meant.tracked].all()
    assert torch.allclose(read.quaternion[meant.tracked], meant.quaternion[meant.tracked], atol=1e-15)
    assert same(read.inputs, meant.inputs) and same(read.actuators, meant.actuators) and same(read.target, meant.target)
    with rosbag2.Reader(bag) as read_by_others:
        assert read_by_others.message_count == T * (k + (inputs > 0) + (actuators > 0) + target)


def test_names_and_times_must_be_those_of_ros(tmp_path: Path) -> None:
    whole = recording(0)
    for name in ("1st", "a disk", "target", "a//b"):
        with pytest.raises(DataError, match="names must be"):
            save_bag(Recording((name, "tip"), *[getattr(whole, f) for f in FIELDS]), tmp_path / "bag")
    early = [getattr(whole, f) for f in FIELDS]
    early[0] = whole.times - 10.0
    with pytest.raises(DataError, match="times must be from 0"):
        save_bag(Recording(("low", "tip"), *early), tmp_path / "bag")
    assert not list(tmp_path.iterdir()), "nothing is left of what failed"
    save_bag(whole, tmp_path / "bag")
    with pytest.raises(WriteError, match="is there already"):
        save_bag(whole, tmp_path / "bag")


FIELDS = ("times", "position", "quaternion", "tracked")
