"""The shape under a load: `LoadedShape` against the equilibrium that another solver finds."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch import Arm, PCCBackbone, decouple
from apcc_torch.errors import ConfigError
from apcc_torch.estimation.loaded_shape import LoadedShape
from apcc_torch.estimation.loaded_shape_settings import LoadedShapeSettings
from apcc_torch.estimation.shape_state import ShapeState
from apcc_torch.model.statics import Equilibrium, equilibrium

D = torch.float64
# Measurements so firm that the priors have no say.
FIRM = LoadedShapeSettings(position_noise=1e-5, angular_noise=1e-4, tendon_noise=1e-5, load=50.0, load_rate=50.0)
ARMS = {
    "three sections": Arm(lengths=[0.105, 0.255, 0.24]),
    "reversed": Arm(lengths=[0.24, 0.255, 0.105]),
    "two, soft": Arm(lengths=[0.3, 0.3], bending_stiffness=0.5),
    "four, standing": Arm(
        lengths=[0.1, 0.15, 0.1, 0.12], base="standing", mass=0.2, bending_stiffness=3.0, axial_stiffness=400.0
    ),
    "sensors between the ends": Arm(lengths=[0.2, 0.2, 0.2], sensors=[0.13, 0.31, 0.47, 0.6]),
    "racks within sections": Arm(lengths=[0.105, 0.255, 0.24], racks=[0.08, 0.29, 0.6]),
    "racks within sections, soft": Arm(
        lengths=[0.3, 0.3], racks=[0.25, 0.5], sensors=[0.28, 0.6], bending_stiffness=0.5
    ),
    "fewer sensors than sections": Arm(lengths=[0.105, 0.255, 0.24], sensors=[0.36, 0.6]),
}


def at_rest(arm: Arm, payload: Tensor, seed: int = 0) -> Equilibrium:
    """Equilibria (R, n_f) of an arm of pieces under random tensions."""
    draw = torch.Generator().manual_seed(seed)
    pulls = 2.0 * torch.rand(*payload.shape, arm.n_tendons, generator=draw, dtype=D)
    solved = equilibrium(arm.dynamics(2), routing=arm.routing(), tensions=pulls, payload=payload)
    assert bool(solved.converged.all())
    return solved


def measured(arm: Arm, q: Tensor) -> tuple[Tensor, Tensor]:
    """Sensor poses and tendon length changes of the arm of pieces."""
    lengths = arm.refined(2)
    T = PCCBackbone(lengths.shape[-1], arm.base_rotation()).pose(q, lengths, *decouple(arm.sensor_places(), lengths))
    return T, q @ arm.routing().matrix(lengths)


def straight(shape: LoadedShape, batch: tuple[int, ...]) -> Tensor:
    lengths = shape.dynamics.lengths.unflatten(0, (-1, 2)).sum(-1)
    return torch.stack((0.0 * lengths, 0.0 * lengths, lengths), dim=-1).flatten().expand(*batch, -1)


def estimated(shape: LoadedShape, T: Tensor, y: Tensor | None, oriented: bool = True, steps: int = 200) -> ShapeState:
    usable = torch.ones(T.shape[:-2], dtype=torch.bool)
    state = shape.initial_state(straight(shape, T.shape[:-3]))
    dt = torch.full(T.shape[:-3], 0.02, dtype=D)
    for _ in range(steps):
        state = shape(state, T, usable, usable & oriented, y, dt)
    return state


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("oriented", [True, False], ids=["poses", "positions"])
def test_it_is_the_equilibrium_under_the_load(name: str, oriented: bool) -> None:
    arm, payload = ARMS[name], torch.tensor([0.0, 0.3], dtype=D)
    q = at_rest(arm, payload).q
    T, y = measured(arm, q)
    shape = LoadedShape.on(arm, FIRM)
    state = estimated(shape, T, y, oriented)
    assert (shape.configuration(state) - q).abs().max() < 2e-4
    assert (state.load - payload).abs().max() < 2e-3


def test_sensors_alone_find_it_where_there_are_as_many_as_sections() -> None:
    arm, payload = ARMS["three sections"], torch.tensor([0.0, 0.2, 0.5], dtype=D)
    q = at_rest(arm, payload).q
    T, _ = measured(arm, q)
    shape = LoadedShape.on(arm, FIRM)
    state = estimated(shape, T, None)
    assert (shape.configuration(state) - q).abs().max() < 2e-4
    assert (state.load - payload).abs().max() < 2e-3


def test_tendons_alone_leave_the_load_at_its_prior_and_the_bends_near() -> None:
    arm = ARMS["three sections"]
    q = at_rest(arm, torch.tensor([0.0], dtype=D)).q
    T, y = measured(arm, q)
    shape = LoadedShape.on(arm, LoadedShapeSettings())
    none = torch.zeros(T.shape[:-2], dtype=torch.bool)
    state = shape.initial_state(straight(shape, (1,)))
    for _ in range(100):
        state = shape(state, T, none, none, y, torch.full((1,), 0.02, dtype=D))
    assert (shape.configuration(state) - q).abs().max() < 1e-2
    assert float(state.load) < 1e-3


def test_an_unknown_tendon_is_left_out_and_a_row_without_a_finite_step_stays() -> None:
    arm = ARMS["three sections"]
    q = at_rest(arm, torch.tensor([0.2, 0.2], dtype=D)).q
    T, y = measured(arm, q)
    y[0, 2] = torch.nan
    shape = LoadedShape.on(arm, FIRM)
    state = estimated(shape, T, y)
    assert (shape.configuration(state)[0] - q[0]).abs().max() < 2e-4
    usable = torch.ones(2, 3, dtype=torch.bool)
    broken = T.clone()
    broken[1] = torch.inf
    later = shape(state, broken, usable, usable, y, torch.full((2,), 0.02, dtype=D))
    assert bool(torch.isfinite(later.sections).all())
    assert torch.equal(later.sections[1], state.sections[1])
    assert not torch.equal(later.load[0], torch.tensor(torch.nan))


def test_pieces_that_are_no_multiple_are_refused() -> None:
    arm = ARMS["three sections"]
    with pytest.raises(ConfigError, match="2 pieces a section"):
        LoadedShape(arm.dynamics(1), arm.routing(), arm.sensor_places())
