"""Numbers of presets go with the arm: they are the paper's on its arm, and as much of any other arm on that one."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from apcc_torch.composition.proportion import in_proportion
from apcc_torch.composition.run_settings import SimulateSettings
from apcc_torch.errors import ConfigError
from apcc_torch.model import arm_scale
from apcc_torch.model.arm import Arm
from apcc_torch.reading import plain
from apcc_torch.settings import About
from composed import changed, composed_realtime


def scaled(arm: Arm, **of: object) -> Arm:
    """An arm of another size: `size` times as long, `weight` times as heavy, as stiff as makes it the same figure."""
    size, weight = float(of.pop("size")), float(of.pop("weight"))  # type: ignore[arg-type]
    return arm.changed(
        lengths=tuple(size * length for length in arm.rest_lengths().tolist()),
        tendon_offset=size * float(arm.tendon_offset),
        mass=weight * float(arm.mass),
        bending_rigidity=weight * size**2 * 0.0778,
        axial_rigidity=weight * 10.0,
    )


def words(arm: Arm) -> list[str]:
    return [f"arm.{key}={list(value) if isinstance(value, tuple) else value}" for key, value in arm.entries().items()]


def test_on_its_own_arm_a_preset_has_the_numbers_that_stand_in_it() -> None:
    c = changed("dynamic_run_2_tuned")
    assert c.plant.pid.K_P == 750.0 and c.plant.tendon_damping == 200.0 and c.controller.elongation_bound == 0.08
    assert c.experiment.setpoints[0] == [0.325, 0.15, -0.275] and c.experiment.payloads == (0.0, 0.25, 0.5)
    assert (c.controller.K, c.experiment.duration, c.feedback.angular_weight) == (1.8, 10.0, 0.03)
    two = changed("robot_2_tuned")
    assert two.plant.pid.K_P == 750.0 and two.experiment.setpoints[0] == [0.15, 0.225, -0.1875]


def test_an_arm_of_the_same_figure_is_driven_as_the_paper_drives_its_own() -> None:
    """Similar: lengths go with size, forces with weight, times with the square root of size."""
    size, weight = 4.0, 9.0
    large = changed("dynamic_run_2_tuned", *words(scaled(Arm.load("arm_1"), size=size, weight=weight)))
    c, pid, time = large.controller, large.plant.pid, math.sqrt(size)
    torch.testing.assert_close(torch.tensor(large.experiment.setpoints[1]), size * torch.tensor([0.215, 0.03, -0.515]))
    assert large.experiment.payloads == pytest.approx([0.0, 0.25 * weight, 0.5 * weight])
    assert pytest.approx((weight / size,) * 2) == (pid.K_P / 750.0, pid.K_I)
    assert (pid.K_D, large.plant.tendon_damping) == pytest.approx([weight / size * time * of for of in (5.0, 200.0)])
    assert (c.epsilon, c.null_gain, c.elongation_bound) == pytest.approx([size * of for of in (0.2, 4.0, 0.08)])
    assert (c.K, large.experiment.duration) == pytest.approx([1.8 / time, 10.0 * time])


def test_a_small_arm_is_driven_no_faster(tmp_path: Path) -> None:
    small = scaled(Arm.load("arm_1"), size=0.2, weight=0.03)
    assert changed("dynamic_run_2_tuned", *words(small)).controller.K == 1.8
    small.save(tmp_path / "small.yaml")
    guards = composed_realtime("experiment=setpoint", f"arm={tmp_path}/small.yaml").guards
    assert guards.max_error == pytest.approx(0.2) and guards.limits.lower == pytest.approx(-0.05)
    assert guards.effort_cap == pytest.approx(0.03 * 250.0) and guards.arrival_error == 1e-3


def test_what_a_command_line_gives_is_taken_as_it_is() -> None:
    large = scaled(Arm.load("arm_1"), size=4.0, weight=9.0)
    c = changed("dynamic_run_2_tuned", *words(large), "experiment.setpoints=[[0.1,0,-2]]", "plant.pid.K_P=300")
    assert c.experiment.setpoints == ([0.1, 0, -2],) and c.plant.pid.K_P == 300.0


def test_sections_of_stiffness_and_load_are_weighed_by_the_one_that_needs_most() -> None:
    """One section of one tendon's plane: the torque to bend it by a radian, over three tendons' d^2 / 2 each."""
    arm = Arm(lengths=(0.4,), mass=0.2, payload=0.3, tendon_offset=0.02, bending_rigidity=0.6, axial_rigidity=1.0)
    torque = 0.6 / 0.4 + 9.81 * (0.2 * 0.2 + 0.3 * 0.4)
    assert arm_scale.tendon_stiffness(arm) == pytest.approx(9.0 * torque / (3.0 * 0.5 * 0.02**2))
    assert arm_scale.tendon_force(arm) == pytest.approx(arm_scale.tendon_stiffness(arm) * 0.02)
    assert arm_scale.rate(arm) == pytest.approx(math.sqrt(torque / (0.2 * 0.4**2 / 3.0 + 0.3 * 0.4**2)))
    assert arm_scale.largest_payload(arm.changed(payload=None)) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [("seed", ["on arm_1", 3], "seed goes with nothing of an arm"), ("threads", ["on arm_3"], "threads goes with")],
)
def test_what_goes_with_nothing_is_refused(key: str, value: object, said: str) -> None:
    values = {"arm": plain(Arm.load("arm_1")), key: value}
    assert About().unit == ""
    with pytest.raises(ConfigError, match=said):
        in_proportion(values, SimulateSettings)


def test_an_arm_that_there_is_not_is_refused() -> None:
    values = {"arm": plain(Arm.load("arm_1")), "controller": {"epsilon": ["on arm_3", 0.1]}}
    with pytest.raises(ConfigError, match="no arm 'arm_3'; did you mean arm_"):
        in_proportion(values, SimulateSettings)
