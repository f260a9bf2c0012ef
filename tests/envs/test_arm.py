"""The environments' arm is that of the configurations."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import yaml

from apcc_torch.composition.conf_path import conf_path
from apcc_torch.envs.arm import Arm
from apcc_torch.envs.dynamic import DynamicArm
from arm_rows import row_parameters

ARM = Arm()
LIKE = torch.empty(0, dtype=torch.float64)


def group(name: str) -> dict[str, object]:
    return yaml.safe_load(Path(conf_path(), name).read_text(encoding="utf-8"))


def test_numbers_are_those_of_the_configurations() -> None:
    robot, plant = group("robot/arm_1.yaml"), group("plant/arm_1.yaml")
    assert list(ARM.rest_lengths) == robot["rest_lengths"] and list(ARM.plant_lengths) == plant["lengths"]
    ends = torch.tensor(ARM.rest_lengths).cumsum(0).tolist()
    assert ends == pytest.approx(robot["sensors"]) and ends == pytest.approx(robot["racks"])
    for name in ("tendon_offset", "tendons_per_rack", "rack_twist"):
        assert getattr(ARM, name) == robot[name], name
    names = (
        "mass",
        "axial_stiffness",
        "bending_stiffness",
        "stiffness_reference",
        "damping_ratio",
        "K_P",
        "K_I",
        "K_D",
    )
    for name in (*names, "tendon_damping"):
        assert getattr(ARM, name) == plant[name], name
    assert robot["base"] == "hanging" and robot["layout"] == plant["layout"] == "coupled"
    assert plant["stiffness_rule"] == "series" and plant["force_limit"] is None


def test_each_model_section_is_two_of_the_plants() -> None:
    pairs = torch.tensor(ARM.plant_lengths).unflatten(0, (-1, 2)).sum(-1)
    assert pairs.tolist() == pytest.approx(ARM.rest_lengths)


def test_one_plant_step_a_period_is_enough() -> None:
    """One step of 10 ms stays within 0.1 mm of sixteen, at full rates and with the largest payload."""
    ends = []
    for substeps in (1, 16):
        arm = DynamicArm(ARM, 0.01, substeps, False, LIKE)
        rows = row_parameters(3, payload=torch.tensor([0.0, 0.25, 0.5], dtype=torch.float64))
        state = arm.initial(rows)
        B = ARM.routing(LIKE).matrix(ARM.lengths(LIKE))
        y = torch.zeros(3, 9, dtype=torch.float64)
        rate = torch.tensor([3.0, -3.0, 0.1] * 3, dtype=torch.float64) @ B
        for k in range(60):
            y_next = y + 0.01 * rate * (1 if k < 30 else -1)
            state, y = arm.step(state, y, y_next, y, rows), y_next
        ends.append(arm.points(state, rows))
    assert float((ends[0] - ends[1]).norm(dim=-1).max()) < 1e-4
