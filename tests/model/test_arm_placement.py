"""Where an arm stands: gravity of a recording's frame turned downwards, and what that leaves of the base."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.errors import ConfigError
from apcc_torch.lie import so3
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_placement import Placement


@pytest.mark.parametrize(
    "gravity", [(0.0, -9.81, 0.0), (1.0, 2.0, 3.0), (0.0, 0.0, 9.81), (0.0, 0.0, -1.6), (1e-9, 0.0, -9.0)]
)
def test_gravity_points_down(gravity: tuple[float, float, float]) -> None:
    placement = Placement(gravity=gravity)
    R, size = placement.upright(), placement.acceleration
    down = R @ torch.tensor(gravity, dtype=torch.float64)
    torch.testing.assert_close(down, torch.tensor([0.0, 0.0, -size], dtype=torch.float64), rtol=0.0, atol=1e-12)
    torch.testing.assert_close(R.mT @ R, torch.eye(3, dtype=torch.float64))


def test_a_base_is_placed_by_word_or_by_rotation() -> None:
    hanging = Arm(lengths=(0.1,))
    assert torch.equal(hanging.base_rotation(), torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)))
    turned = Arm(lengths=(0.1,), placement=Placement(rotation=(torch.pi / 2, 0.0, 0.0), gravity=(0.0, -9.81, 0.0)))
    torch.testing.assert_close(turned.base_rotation(), hanging.base_rotation())
    torch.testing.assert_close(
        turned.dynamics().gravity(q := torch.full((3,), 0.1).double()), hanging.dynamics().gravity(q)
    )
    weightless = Arm(lengths=(0.1,), placement=Placement(rotation=(0.1, 0.2, 0.3), gravity=(0.0, 0.0, 0.0)))
    assert torch.equal(weightless.base_rotation(), so3.exp(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)))
    assert not bool(weightless.dynamics().gravity(q).any())


@pytest.mark.parametrize("name", ["position", "rotation", "gravity"])
@pytest.mark.parametrize("value", [(0.0, 0.0), (0.0, 0.0, 1.0, 0.0)])
def test_three_numbers_are_asked_for(name: str, value: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match=f"{name} must be three numbers"):
        Placement(**{name: value})
