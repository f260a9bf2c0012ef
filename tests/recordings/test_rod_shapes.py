"""Shapes of a rod as SoRoSim's files hold them, and what plants make of them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from apcc_torch.errors import DataError
from apcc_torch.evaluation.statics import statics_scores
from apcc_torch.model.arm import Arm
from apcc_torch.recordings.rod_shapes import read_rod_shapes
from composed import composed_evaluate


def write(path: Path) -> None:
    """One shape of two stations a half: a rod of 0.4 m that no load bends."""
    lines = [
        "rowLabel,gravity,mid_wrench,tip_wrench,seg1_s01,seg1_s02,seg2_s01,seg2_s02",
        "arclength,0,0.2,0.4,0,1,0,1",
    ]
    rows = {"EulX": [0] * 7, "EulY": [0] * 7, "EulZ": [0, 0, 0.1, 0, 0, 0, 0], "Px": [1, 0, 2, 0, 0.2, 0.2, 0.4]}
    rows |= {"Py": [2, 0, 0, 0, 0, 0, 0], "Pz": [3, 0, 0, 0, 0, 0, 0]}
    lines += [f"{name}_s001," + ",".join(map(str, row)) for name, row in rows.items()]
    path.write_text("\n".join(lines) + "\n")


def test_files_axes_become_the_arms(tmp_path: Path) -> None:
    write(tmp_path / "one.csv")
    shapes = read_rod_shapes(tmp_path / "one.csv")
    assert shapes.gravity.tolist() == [[3.0, -2.0, 1.0]]
    assert shapes.tip.tolist() == [[0.1, 0.0, 0.0, 0.0, 0.0, 2.0]] and not bool(shapes.middle.any())
    assert shapes.shares.tolist() == [0.0, 1.0]
    torch.testing.assert_close(shapes.places[0, :, -1], torch.tensor([[0.0, 0.0, 0.2], [0.0, 0.0, 0.4]]).double())
    (tmp_path / "one.csv").write_text("rowLabel,gravity,mid_wrench,tip_wrench\na,1,2,3\n")
    with pytest.raises(DataError, match="holds no shapes of a rod in two halves"):
        read_rod_shapes(tmp_path / "one.csv")


def test_plants_take_the_shapes_of_another_simulator(shared_data: Path) -> None:
    settings = composed_evaluate("data=sorosim")
    assert isinstance(settings.arm, Arm)
    shapes = read_rod_shapes(shared_data / "sorosim_statics" / "TPURod_statics.csv").each(250)
    found = {(score.method, score.body): score.mean for score in statics_scores(settings.arm, shapes, "shapes")}
    assert found["plant=rod, plant.refine=6", 2] < 0.3 < 5.0 < found["plant=sections, as in the model", 2]
