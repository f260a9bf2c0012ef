"""What an arm's file says of tendons, sections and bodies one by one, against what racks and reference sections say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_tendons import Actuation, Tendons

LENGTHS = (0.2, 0.25)


def test_tendons_told_one_by_one_are_those_of_the_racks() -> None:
    racked = Arm(lengths=LENGTHS, tendon_offset=0.01)
    told = Arm(
        lengths=LENGTHS,
        tendons=Tendons(angles=racked.routing().angles.tolist(), offsets=0.01, ends=[1, 1, 1, 2, 2, 2]),  # type: ignore[arg-type]
    )
    assert told.n_tendons == racked.n_tendons == 6
    assert torch.equal(told.routing().matrix(told.rest_lengths()), racked.routing().matrix(racked.rest_lengths()))


def test_what_is_not_told_is_as_on_the_racks() -> None:
    arm = Arm(
        lengths=LENGTHS, tendon_offset=0.01, racks=(0.1, 0.4), tendons=Tendons(angles=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0))
    )
    routing = arm.routing()
    assert routing.angles.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert routing.anchors.tolist() == [0.1] * 3 + [0.4] * 3
    assert routing.offsets.tolist() == [0.01] * 6
    arm = Arm(lengths=LENGTHS, tendons=Tendons(angles=(0.0, 1.0), ends=(2, 1)), layout="independent")
    assert arm.routing().anchors.tolist() == [0.45, 0.2]
    assert arm.routing().starts.tolist() == [0.2, 0.0]
    assert arm.actuation.driving(arm.n_tendons) == (0, 1)


@pytest.mark.parametrize("factor", [1, 3])
def test_rigidities_and_masses_are_those_of_reference_sections(factor: int) -> None:
    reference = Arm(lengths=LENGTHS, mass=0.9, axial_stiffness=80.0, bending_stiffness=0.5, stiffness_reference=0.2)
    told = Arm(lengths=LENGTHS, masses=(0.4, 0.5), axial_rigidity=16.0, bending_rigidity=(0.1, 0.1))
    for one, other in zip(reference.dynamics(factor).buffers(), told.dynamics(factor).buffers(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-14, atol=0.0)


def test_a_whole_arm_comes_back_from_its_file(tmp_path: Path) -> None:
    arm = Arm(
        name="mine",
        lengths=LENGTHS,
        masses=(0.1, 0.2),
        axial_rigidity=30.0,
        bending_rigidity=[1e-5, 2e-5],
        rest_bend=[[0.1, 0.0], [0.0, -0.1]],
        mounts=[[0.0, 0.0, 0.01], [0.0, 0.0, 0.0]],
        tendons=Tendons(angles=(0.0, 1.0), offsets=[0.01, 0.02], ends=(2, 1)),
        actuation=Actuation(inputs=(1, 0), pulls=[1e-3, -1e-3], friction=0.1),
    )
    arm.save(tmp_path / "arm.yaml", "two lines\nof comment")
    text = (tmp_path / "arm.yaml").read_text()
    assert text.startswith("# two lines\n# of comment\nname: mine\nlengths: [0.2, 0.25]\n")
    assert "mass:" not in text and "placement" not in text
    assert Arm.load(tmp_path / "arm.yaml") == arm


@pytest.mark.parametrize(
    ("told", "error", "words"),
    [
        ({"masses": (0.1,)}, ConfigError, "masses must have 2 entries, got 1"),
        ({"masses": (0.1, -0.1)}, ValueRangeError, "masses must be positive"),
        ({"axial_rigidity": [1.0, 2.0, 3.0]}, ConfigError, "axial_rigidity must have 2 entries, got 3"),
        ({"rest_bend": [[0.1, 0.2]]}, ConfigError, "rest_bend must be 2 rows of 2 numbers"),
        ({"mounts": [[0.0, 0.0, "up"]] * 2}, ConfigError, "mounts must be 2 rows of 3 numbers"),
        ({"tendons": Tendons(angles=(0.0, 1.0))}, ConfigError, r"tendons\.ends must have 2 entries, as the racks"),
        ({"tendons": Tendons(ends=(1, 1))}, ConfigError, r"tendons\.angles must have 2 entries, as the racks"),
        ({"tendons": Tendons(angles=(0.0,), ends=(1, 2))}, ConfigError, r"tendons\.ends must have 1 entries"),
        ({"tendons": Tendons(angles=(0.0,), ends=(3,))}, ConfigError, r"tendons\.ends must be sections from 1 to 2"),
        ({"tendons": Tendons(angles=())}, ConfigError, "at least one tendon"),
        ({"tendons": Tendons(offsets=[0.1, 0.2])}, ConfigError, r"tendons\.offsets must have 6 entries, got 2"),
        ({"actuation": Actuation(inputs=(0, 1))}, ConfigError, r"actuation\.inputs must have 6 entries"),
        ({"actuation": Actuation(pulls=[1.0, 2.0])}, ConfigError, r"actuation\.pulls must have 6 entries, got 2"),
    ],
)
def test_what_does_not_fit_the_arm_is_refused(told: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Arm(lengths=LENGTHS, **told)


def test_arms_of_many_lengths_have_each_their_tendons_by_section() -> None:
    tendons = Tendons(angles=(0.0, 1.0, 2.0), ends=(2, 1, 2))
    rows = torch.tensor([[[0.2, 0.1]], [[0.15, 0.25]]], dtype=torch.float64)
    B = Arm(lengths=rows, tendons=tendons).routing().matrix(rows)
    for i, (lengths,) in enumerate(rows.tolist()):
        arm = Arm(lengths=lengths, tendons=tendons)
        assert torch.equal(B[i, 0], arm.routing().matrix(arm.rest_lengths()))
