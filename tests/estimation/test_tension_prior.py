"""What unknown tensions make of an arm: against the equilibria of random ones, and what it does for few sensors."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch import Arm, PCCBackbone, decouple
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.tension_prior import BESIDE, tension_information
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.statics import equilibrium

D = torch.float64
WEIGHTLESS = Placement(gravity=(0.0, 0.0, 0.0))
ARMS = {
    "three sections": Arm(lengths=[0.105, 0.255, 0.24], placement=WEIGHTLESS),
    "all tendons at the tip": Arm(lengths=[0.1, 0.2, 0.15], racks=[0.45], placement=WEIGHTLESS),
    "of two stiffnesses": Arm(lengths=[0.2, 0.2], bending_rigidity=[0.08, 0.04], placement=WEIGHTLESS),
}


def at_rest(arm: Arm, forces: Tensor, refine: int) -> Tensor:
    """Equilibria (count, n_f) of a weightless arm under forces (count, n_a) of the tendons, of both signs."""
    payload = torch.zeros(len(forces), dtype=D)
    solved = equilibrium(arm.dynamics(refine), routing=arm.routing(), tensions=forces, payload=payload)
    assert bool(solved.converged.all())
    return solved.q


def normal(arm: Arm, count: int) -> Tensor:
    return torch.randn(count, arm.n_tendons, generator=torch.Generator().manual_seed(0), dtype=D)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("refine", [1, 3])
def test_it_is_how_equilibria_under_random_tensions_scatter(name: str, refine: int) -> None:
    """Independent forces scatter as orthonormal ones do, each as likely as the next."""
    arm = ARMS[name]
    forces = 1e-3 * torch.linalg.qr(normal(arm, arm.n_tendons))[0]
    bends = at_rest(arm, forces, refine).unflatten(-1, (-1, refine, 3)).sum(-2)[..., :2].flatten(-2)
    seen = bends.mT @ bends
    seen = seen / seen.diagonal().max() + BESIDE**2 * torch.eye(len(seen), dtype=D)
    B = arm.routing().matrix(arm.refined(refine))
    believed = torch.linalg.inv(tension_information(B, arm.dynamics(refine).stiffness_diagonal, refine))
    own = torch.tensor([i for i in range(len(believed)) if i % 3 != 2])
    torch.testing.assert_close(believed[own][:, own], seen, rtol=0.0, atol=1e-12)
    elongations = torch.arange(2, len(believed), 3)
    assert torch.equal(believed[elongations][:, elongations].round(decimals=9), torch.eye(len(elongations), dtype=D))
    assert believed[elongations][:, own].abs().max() < 1e-12


def test_an_arm_that_no_tendon_bends_keeps_a_prior() -> None:
    stiffness = Arm(lengths=[0.2, 0.2]).dynamics().stiffness_diagonal
    assert bool(torch.linalg.eigvalsh(tension_information(torch.zeros(6, 2, dtype=D), stiffness, 1)).gt(0.0).all())


def estimated(arm: Arm, T: Tensor, settings: LoadedShapeSettings) -> Tensor:
    """Configurations of the arm's pieces, from positions alone."""
    shape = LoadedShape.on(arm, settings)
    lengths = arm.rest_lengths()
    state = shape.initial_state(torch.nn.functional.pad(lengths.unsqueeze(-1), (2, 0)).flatten().expand(len(T), -1))
    usable = torch.ones(T.shape[:-2], dtype=torch.bool)
    for _ in range(80):
        state = shape(state, T, usable, ~usable, None, torch.full((len(T),), 0.05, dtype=D))
    return shape.configuration(state)


def distance(arm: Arm, q: Tensor, q_true: Tensor) -> Tensor:
    """Mean distance of points of two shapes of the arm of two pieces a section, m."""
    model, lengths = PCCBackbone(2 * arm.n_sections, arm.base_rotation()), arm.refined(2)
    return (model.points(q, lengths, 40) - model.points(q_true, lengths, 40)).norm(dim=-1).mean()


@pytest.mark.parametrize("sensors", [[0.6], [0.3, 0.6], [0.2, 0.4]])
def test_few_positions_tell_more_with_it_than_sections_that_are_bent_independently(sensors: list[float]) -> None:
    arm = Arm(lengths=[0.2, 0.2, 0.2], sensors=sensors, placement=WEIGHTLESS)
    racks = 6.0 * normal(arm, 40).unflatten(-1, (-1, 3))
    q = at_rest(arm, (racks - racks.mean(-1, keepdim=True)).flatten(-2), 2)  # the three of a rack only bend
    T = PCCBackbone(6, arm.base_rotation()).pose(q, arm.refined(2), *decouple(arm.sensor_places(), arm.refined(2)))
    settings = LoadedShapeSettings()
    found = distance(arm, estimated(arm, T, settings), q)
    # Independent bends are those of an arm each of whose tendons acts on one section.
    apart = arm.changed(layout="independent")
    assert found < 0.97 * distance(arm, estimated(apart, T, settings), q)


def test_what_nothing_tells_stays_as_the_arm_was_built() -> None:
    arm = ARMS["three sections"].changed(rest_bend=[[0.2, 0.0], [0.0, -0.3], [0.1, 0.1]])
    shape = LoadedShape.on(arm, LoadedShapeSettings())
    lengths, none = arm.rest_lengths(), torch.zeros(1, 3, dtype=torch.bool)
    state = shape.initial_state(torch.nn.functional.pad(lengths.unsqueeze(-1), (2, 0)).flatten().expand(1, -1))
    for _ in range(20):
        state = shape(
            state, torch.eye(4, dtype=D).expand(1, 3, 4, 4), none, none, None, torch.full((1,), 0.05, dtype=D)
        )
    torch.testing.assert_close(shape.strain(state)[0], shape.rest, rtol=0, atol=1e-9)
    # Tendons that its bend stretches hold it back a little.
    assert shape.rest[[0, 4, 6]].tolist() == pytest.approx([0.2, -0.3, 0.1], abs=0.02)
