"""What a section's strain says of its pieces where tendons end within it, against equilibria of random tensions."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch import Arm
from apcc_torch.estimation.uneven_tension import uneven_tension
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.arm_tendons import Tendons
from apcc_torch.model.statics import equilibrium

D = torch.float64
WEIGHTLESS = Placement(gravity=(0.0, 0.0, 0.0))
LENGTHS = [0.105, 0.255, 0.24]
WITHIN = {
    "each rack in its section": Arm(lengths=LENGTHS, racks=[0.08, 0.29, 0.5], placement=WEIGHTLESS),
    "independent": Arm(lengths=LENGTHS, racks=[0.08, 0.29, 0.5], layout="independent", placement=WEIGHTLESS),
    "of two stiffnesses": Arm(
        lengths=[0.2, 0.2], racks=[0.15, 0.3], bending_rigidity=[0.08, 0.04], placement=WEIGHTLESS
    ),
}
EVEN = {
    "racks at the ends": Arm(lengths=LENGTHS),
    "tendons to some ends": Arm(lengths=LENGTHS, tendons=Tendons(angles=(0.0, 2.0, 4.0), ends=(1, 3, 3))),
    "one rack": Arm(lengths=LENGTHS, racks=[0.6]),
}


def uneven(arm: Arm, refine: int) -> Tensor | None:
    pieces = arm.refined(refine)
    return uneven_tension(arm.routing().matrix(pieces), arm.dynamics(refine).stiffness_diagonal, refine, pieces)


@pytest.mark.parametrize("name", WITHIN)
@pytest.mark.parametrize("refine", [2, 3])
def test_pieces_depart_from_even_shares_as_equilibria_do(name: str, refine: int) -> None:
    arm = WITHIN[name]
    forces = torch.randn(20, arm.n_tendons, generator=torch.Generator().manual_seed(0), dtype=D)
    solved = equilibrium(arm.dynamics(refine), routing=arm.routing(), tensions=forces, payload=torch.zeros(20, dtype=D))
    assert bool(solved.converged.all())
    pieces = solved.q.unflatten(-1, (-1, refine, 3))
    apart = (pieces - pieces.mean(-2, keepdim=True)).flatten(-3)
    U, c = uneven(arm, refine), pieces.sum(-2).flatten(-2)
    assert U is not None
    assert apart.abs().max() > 0.02
    torch.testing.assert_close(c @ U.mT, apart, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("name", EVEN)
def test_there_is_nothing_to_say_of_tendons_that_end_where_sections_do(name: str) -> None:
    assert uneven(EVEN[name], 2) is None


def test_rows_of_arms_have_each_their_own() -> None:
    lengths = torch.tensor([[0.2, 0.2], [0.15, 0.25]], dtype=D)
    every = uneven(Arm(lengths=lengths, racks=[0.1, 0.4]), 2)
    assert every is not None
    for row, U in zip(lengths.tolist(), every, strict=True):
        alone = uneven(Arm(lengths=row, racks=[0.1, 0.4]), 2)
        assert alone is not None
        torch.testing.assert_close(U, alone, rtol=0.0, atol=1e-12)


def test_stretch_tells_no_tensions_of_an_arm_that_is_stiff_along_itself() -> None:
    arm = Arm(lengths=LENGTHS, racks=[0.08, 0.29, 0.5], axial_rigidity=1e5)
    U = uneven(arm, 2)
    assert U is not None
    assert U.abs().max() < 1.0 and U[:, 2::3].abs().max() < 1e-6
