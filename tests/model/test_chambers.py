"""Chambers: their matrix and their forces, each by a way of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import ApccError, ConfigError, ValueRangeError
from apcc_torch.model.arm import Arm
from apcc_torch.model.chambers import ChamberForce, Chambers
from apcc_torch.model.statics import equilibrium

TRUNK = Arm.load("soft_trunk")


def test_a_chamber_gets_longer_by_what_a_fibre_at_its_place_does() -> None:
    """By geometry alone: an arc's fibre at an offset towards the bend is shorter by offset times the angle."""
    chambers = Chambers(offsets=0.02, per_section=4)
    lengths = torch.tensor([0.1, 0.15]).double()
    q = torch.tensor([0.3, 0.0, 0.0, 0.0, -0.4, 0.01]).double()
    y = chambers.routing(lengths).lengths(q, lengths)
    first, second = torch.tensor([-0.006, 0.0, 0.006, 0.0]), torch.tensor([0.01, 0.018, 0.01, 0.002])
    torch.testing.assert_close(y, torch.cat((first, second)).double(), atol=1e-8, rtol=0.0)


def test_the_generalized_force_is_the_work_of_the_pressures() -> None:
    """p dV of chambers of fixed area is A p dy, so B A p is the gradient of sum A p y."""
    chambers, lengths = TRUNK.chambers, TRUNK.rest_lengths()
    assert chambers is not None
    p = 1e4 * torch.rand(6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    area = torch.tensor(chambers.areas, dtype=torch.float64)
    q = (0.3 * torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(2))).requires_grad_()
    routing = TRUNK.routing()
    work = (area * p * routing.lengths(q, lengths)).sum()
    (tau,) = torch.autograd.grad(work, q)
    torch.testing.assert_close(routing.generalized_force(area * p, lengths), tau, atol=1e-12, rtol=1e-12)


def test_equal_pressure_makes_a_hanging_section_longer_as_a_spring() -> None:
    k, area, p, mass = 500.0, 2e-4, 3e4, 0.1
    arm = Arm(lengths=[0.2], mass=mass, axial_rigidity=[k * 0.2], chambers=Chambers(areas=area, max_pressure=1e5))
    u = ChamberForce(torch.full((3,), area).double())(torch.full((3,), p).double())
    q = equilibrium(arm.dynamics(), routing=arm.routing(), tensions=-u).q
    # Along a section in even strain its own weight acts with half of it.
    expected = (3.0 * area * p + 0.5 * mass * 9.81) / k
    torch.testing.assert_close(q, torch.tensor([0.0, 0.0, expected]).double(), atol=1e-7, rtol=1e-6)


@given(st.floats(0.0, 1e5), st.floats(0.0, 5e4), st.floats(0.0, 1e-5), st.sampled_from([torch.float32, torch.float64]))
def test_pressure_is_the_reverse_of_force(p: float, rest: float, growth: float, dtype: torch.dtype) -> None:
    area = torch.tensor([1e-4, 3e-4], dtype=dtype)
    chambers = ChamberForce(area, growth + 0.0 * area, rest + 0.0 * area)
    wanted = torch.tensor([[p, 0.5 * p], [0.0, p]], dtype=dtype)
    found = chambers.pressure(chambers(wanted))
    torch.testing.assert_close(found, wanted, atol=1.0 if dtype == torch.float32 else 1e-6, rtol=1e-5)
    by_hand = area * wanted * (1.0 + growth * wanted) - area * rest * (1.0 + growth * rest)
    torch.testing.assert_close(chambers(wanted), by_hand, atol=1e-4, rtol=1e-5)


def test_an_arm_with_chambers_is_saved_and_read(tmp_path: Path) -> None:
    TRUNK.save(tmp_path / "arm.yaml")
    assert Arm.load(tmp_path / "arm.yaml") == TRUNK
    assert TRUNK.n_tendons == 6 and Arm.load("arm_1").chambers is None


@pytest.mark.parametrize(
    ("changes", "said", "error"),
    [
        ({"angles": (0.0, 1.0)}, "chambers.angles must have 6 entries", ConfigError),
        ({"ends": (1, 2, 3), "angles": (0.0, 1.0, 2.0)}, "sections from 1 to 2", ConfigError),
        ({"ends": (1, 2), "angles": (0.0, 1.0, 2.0)}, "chambers.ends must have 3 entries", ConfigError),
        ({"areas": (1e-4, 2e-4)}, "chambers.areas must have 6 entries", ConfigError),
        ({"rest_pressure": 2e5}, "chambers.rest_pressure must be from min_pressure", ValueRangeError),
        ({"min_pressure": 5e4}, "chambers.rest_pressure must be from min_pressure", ValueRangeError),
        ({"offsets": 0.5}, "chambers.offsets must be less than the arm's length", ValueRangeError),
        ({"areas": -1e-4}, "areas must be in", ValueRangeError),
        ({"ends": ()}, "name at least one", ConfigError),
    ],
)
def test_chambers_that_do_not_fit_are_refused(changes: dict[str, object], said: str, error: type[ApccError]) -> None:
    with pytest.raises(error, match=said):
        Arm(lengths=[0.145, 0.145], chambers=Chambers(**changes))
