"""An arm's description as blocks of parameters, and back as the identified arm."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.identification.arm_blocks import KEYS, Spreads, account, arm_parameters, identified_arm
from apcc_torch.identification.tendon_arm import TendonArm
from apcc_torch.model.arm import Arm
from apcc_torch.settings import names
from identified_arms import SMALL, random_drive


def test_every_block_has_a_spread_and_a_key() -> None:
    blocks = arm_parameters(SMALL, Spreads()).blocks
    assert tuple(blocks) == tuple(KEYS) == names(Spreads)
    for key in KEYS.values():
        part: object = SMALL
        for name in key.split("."):
            part = getattr(part, name)


def test_blocks_hold_what_the_file_says() -> None:
    values = arm_parameters(SMALL, Spreads()).values(arm_parameters(SMALL, Spreads()).nominal())
    assert values["rest_length"].tolist() == [0.1, 0.1]
    assert torch.equal(values["angle"], SMALL.routing().angles)
    assert values["offset"].tolist() == [0.005] * 6
    assert values["base_rotation"].tolist() == pytest.approx([torch.pi, 0.0, 0.0])
    # Without a rigidity the reference section's stiffness is spread over the sections' lengths.
    soft = Arm(lengths=(0.1, 0.2), bending_stiffness=0.5, axial_stiffness=80.0, stiffness_reference=0.2)
    blocks = arm_parameters(soft, Spreads(friction=0.0)).blocks
    assert blocks["bending_rigidity"].nominal.tolist() == pytest.approx([0.1, 0.1])
    assert blocks["axial_rigidity"].nominal.tolist() == pytest.approx([16.0, 16.0])


@pytest.mark.parametrize(
    ("arm", "spreads", "error", "words"),
    [
        (SMALL, Spreads(offset=(0.1, 0.2)), ConfigError, r"spread\.offset must have 6 entries, got 2"),
        (Arm(lengths=(0.1,)), Spreads(), ValueRangeError, "friction must be positive"),
    ],
)
def test_spreads_that_do_not_fit_are_refused(arm: Arm, spreads: Spreads, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        arm_parameters(arm, spreads)


@pytest.mark.parametrize("places", [{}, {"sensors": (0.04, 0.1, 0.2), "racks": (0.09, 0.2)}])
def test_the_identified_arm_predicts_what_the_fit_did(tmp_path: Path, places: dict[str, object]) -> None:
    arm = SMALL.changed(**places)
    blocks = arm_parameters(arm, Spreads(gravity=1.0))
    values = blocks.values(torch.linspace(-1.0, 1.0, len(blocks), dtype=torch.float64))
    arm_there = identified_arm(arm, values)
    arm_there.save(tmp_path / "arm.yaml", account(blocks))
    again = Arm.load(tmp_path / "arm.yaml")
    assert again == arm_there
    drive = random_drive(5, seed=4)
    start = arm_parameters(again, Spreads())
    predicted = TendonArm(again).predict(drive, start.values(start.nominal()))
    torch.testing.assert_close(predicted, TendonArm(arm).predict(drive, values), rtol=0.0, atol=1e-9)


def test_the_file_says_what_was_fitted(tmp_path: Path) -> None:
    held = dict.fromkeys(names(Spreads), 0.0) | {"offset": 0.1}
    blocks = arm_parameters(SMALL, Spreads(**held))
    SMALL.save(tmp_path / "arm.yaml", account(blocks))
    lines = (tmp_path / "arm.yaml").read_text().splitlines()
    assert lines[0] == "# Identified: tendons.offsets."
    assert lines[1].startswith("# Taken over: lengths, tendons.angles, actuation.pulls,")


def test_a_spread_that_is_no_number_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"angle must be a number, a list of numbers"):
        Spreads(angle="much")  # type: ignore[arg-type]
