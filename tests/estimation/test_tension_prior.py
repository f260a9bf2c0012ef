"""What unknown tensions make of an arm: against the equilibria of random ones, and what it does for few sensors."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch import Arm, PCCBackbone, decouple
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.tension_prior import BESIDE, tension_information, tension_scatter
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.arm_tendons import Actuation
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
def test_it_is_how_equilibria_under_random_tensions_and_loads_scatter(name: str, refine: int) -> None:
    """Independent forces scatter as orthonormal ones do; a load at the tip of an arm without weight stretches it."""
    arm, L = ARMS[name], ARMS[name].rest_lengths()
    tensions = tension_scatter(arm)
    forces = 1e-4 * tensions * torch.linalg.qr(normal(arm, arm.n_tendons))[0]
    strains = at_rest(arm, forces, refine).unflatten(-1, (-1, refine, 3)).sum(-2)
    bends = strains[..., :2].flatten(-2)
    bent = over_largest(bends.mT @ bends) + BESIDE**2 * torch.eye(bends.shape[-1], dtype=D)
    pulled = strains[..., 2] / L
    hanging = arm.changed(placement=Placement(), mass=1e-9, masses=None)
    none = torch.zeros(1, arm.n_tendons, dtype=D)
    load = torch.full((1,), 1e-4, dtype=D)
    solved = equilibrium(hanging.dynamics(refine), routing=arm.routing(), tensions=none, payload=load)
    hung = solved.q.unflatten(-1, (-1, refine, 3)).sum(-2)[..., 2] / L
    own = torch.eye(len(L), dtype=D)
    stretched = over_largest(over_largest(pulled.mT @ pulled) + over_largest(hung.mT @ hung) + own) + BESIDE**2 * own
    B = arm.routing().matrix(arm.refined(refine))
    stiffness = arm.dynamics(refine).stiffness_diagonal
    believed = torch.linalg.inv(tension_information(B, stiffness, refine, arm.refined(refine), tensions))
    own = torch.tensor([i for i in range(len(believed)) if i % 3 != 2])
    torch.testing.assert_close(believed[own][:, own], bent, rtol=0.0, atol=1e-10)
    torch.testing.assert_close(believed[2::3][:, 2::3], stretched, rtol=0.0, atol=1e-4)
    assert believed[2::3][:, own].abs().max() < 1e-12


def over_largest(scatter: Tensor) -> Tensor:
    return scatter / scatter.diagonal().max()


def test_a_motor_that_sets_a_length_stretches_a_long_tendon_by_more() -> None:
    arm = Arm(lengths=[0.1, 0.2], racks=[0.1, 0.3])
    stiffness = [1000.0] * 3 + [4000.0] * 3
    assert tension_scatter(arm).tolist() == pytest.approx([1 / 3] * 3 + [1.0] * 3)
    apart = arm.changed(layout="independent")  # the last three act from the first rack on
    assert tension_scatter(apart).tolist() == pytest.approx([0.5] * 3 + [1.0] * 3)
    stiff = arm.changed(actuation=Actuation(stiffness=stiffness))
    assert tension_scatter(stiff).tolist() == pytest.approx([1 / 12] * 3 + [1.0] * 3)
    forced = arm.changed(actuation=Actuation(sets="tension", stiffness=stiffness))
    assert tension_scatter(forced).tolist() == [1.0] * 6


def test_an_arm_that_no_tendon_bends_keeps_a_prior() -> None:
    arm = Arm(lengths=[0.2, 0.2])
    none = torch.zeros(6, 2, dtype=D)
    information = tension_information(none, arm.dynamics().stiffness_diagonal, 1, arm.rest_lengths(), none[0])
    assert bool(torch.linalg.eigvalsh(information).gt(0.0).all())


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
    racks = (8.0 * tension_scatter(arm) * normal(arm, 40)).unflatten(-1, (-1, 3))
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
