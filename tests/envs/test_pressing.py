"""Dynamic environments of arms with chambers: what an action presses, where the arm rests, what is seen of it."""

from __future__ import annotations

from math import exp

import pytest
import torch
from torch import Tensor

from apcc_torch.control.pid import TendonReference
from apcc_torch.envs.dynamic import DynamicArm
from apcc_torch.envs.pressing import Pressing
from apcc_torch.envs.row_trees import map_rows
from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_placement import Placement
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.plant_state import PlantState
from arm_rows import IDS, actions, make, row_parameters
from laws import generator, uniform

LIKE = torch.empty(0, dtype=torch.float64)
TRUNK = Arm.load("soft_trunk")
UNLIKE = TRUNK.changed(
    lengths=(0.1, 0.15, 0.12),
    masses=(0.1, 0.1, 0.05),
    axial_rigidity=None,
    bending_rigidity=None,
    bending_stiffness=0.3,
    chambers=TRUNK.chambers.changed(
        offsets=0.015, areas=2e-4, per_section=4, min_pressure=-1e4, max_pressure=(4e4,) * 4 + (9e4,) * 8
    )
    if TRUNK.chambers
    else None,
)
LEANING = TRUNK.changed(placement=Placement(rotation=(0.0, 2.0, 0.3)), bending_rigidity=(0.03, 0.03))


def row(state: PlantState, i: int) -> PlantState:
    return map_rows(lambda rows: rows[i], state)


def test_rows_are_the_plants_they_would_be_alone() -> None:
    """Against plants of section lengths and stiffness of their own, built from the arm's numbers."""
    payload, lengths = torch.tensor([0.0, 0.02]).double(), uniform((2, 2), 0.9, 1.1, torch.float64, generator(1))
    rows = row_parameters(2, payload=payload, lengths=lengths, stiffness=torch.tensor([0.8, 1.2]).double())
    arm = DynamicArm(TRUNK, 0.02, True, LIKE, plant={"substeps": 2})
    start = arm.initial(rows)
    p = uniform((2, 6), 0.0, 1e5, torch.float64, generator(2))
    later = arm.step(start, start.held, p, p, rows)
    for i in range(2):
        stiffer = float(rows.stiffness[i])
        own = TRUNK.changed(
            lengths=tuple((lengths[i] * TRUNK.rest_lengths()).tolist()),
            axial_rigidity=(stiffer * 91.6, stiffer * 68.8),
            bending_rigidity=(stiffer * 1.02e-2, stiffer * 4.67e-3),
        )
        alone = Plant.on(own, payload[i], PlantSettings())
        now = row(start, i)
        for _ in range(2):
            now = alone.step(now, TendonReference(0.0 * p[i], 0.0 * p[i], pressure=p[i]), 0.01)
        torch.testing.assert_close(later.arm.q[i], now.arm.q, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(later.held[i], now.held, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("nominal", [TRUNK, UNLIKE, LEANING], ids=["hanging", "four chambers", "leaning"])
def test_it_starts_at_rest_under_the_pressures_of_rest(nominal: Arm) -> None:
    arm = DynamicArm(nominal, 0.01, False, LIKE)
    rows = row_parameters(2, payload=torch.tensor([0.0, 0.03]).double())
    start = arm.initial(rows)
    later = arm.step(start, start.held, start.held, start.held, rows)
    assert (later.arm.q - start.arm.q).abs().max() < 1e-9 and (later.held == start.held).all()
    assert start.arm.q[1].abs().sum() > start.arm.q[0].abs().sum(), "the payload pulls"


def test_a_desired_configuration_is_held_by_what_balances_it() -> None:
    """An arm of the believed kind that is there stays there, under pressures that know nothing of the plant."""
    q = torch.tensor([[0.3, -0.2, 0.004, -0.25, 0.2, 0.006]]).double()
    pressing, arm = Pressing(TRUNK, LIKE), DynamicArm(TRUNK, 0.01, False, LIKE, plant={"refine": 1})
    p = pressing.holding(q @ TRUNK.routing().matrix(TRUNK.rest_lengths()))
    rows = row_parameters(1)
    start = arm.initial(rows)
    there = start._replace(arm=start.arm._replace(q=q), held=p)
    later = arm.step(there, p, p, q, rows)
    torch.testing.assert_close(later.arm.q, q, rtol=0.0, atol=1e-9)


def test_an_action_is_a_pressure_and_the_valves_follow_it() -> None:
    envs = make("apcc/Reach-v0", 2, arm=UNLIKE, dynamics="dynamic", action="pressures", payload=(0.0, 0.0))
    assert envs.single_action_space.shape == (12,)
    envs.reset(seed=1)
    least, most = -1e4, torch.tensor([4e4] * 4 + [9e4] * 8).double()
    asked = torch.linspace(-1.0, 1.0, 12).expand(2, -1)
    observation, *_ = envs.step(asked)
    assert envs.state is not None
    told = least + 0.5 * (asked.double() + 1.0) * (most - least)
    torch.testing.assert_close(envs.state.y, told, rtol=1e-6, atol=1e-3)
    at = told + exp(-0.01 / 0.05) * (2e4 - told)
    seen = torch.cat((at, told), dim=-1) / most.repeat(2)  # after three sensors' positions and velocities
    torch.testing.assert_close(observation[:, 18:42], seen.float(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("action", ["pressures", "task_velocity", "adaptation"])
def test_every_environment_takes_an_arm_with_chambers(name: str, action: str) -> None:
    drawn = {"lengths": (0.95, 1.05), "stiffness": (0.9, 1.1), "payload": (0.0, 0.02)}
    envs = make(name, 2, arm="soft_trunk", dynamics="dynamic", action=action, **drawn)
    before, _ = envs.reset(seed=0)
    for k in range(3):
        after, reward, _, truncated, _ = envs.step(actions(envs, k))
    bounds = envs.simulator.bounds
    assert not truncated.any() and torch.isfinite(reward).all() and (after.abs() < bounds).all()
    assert (after - before).abs().max() > 1e-3


def test_an_action_that_is_no_number_leaves_its_row_where_it_was() -> None:
    envs = make("apcc/Reach-v0", 2, arm="soft_trunk", dynamics="dynamic", action="pressures")
    envs.reset(seed=0)
    asked = torch.zeros(2, 6)
    asked[1, 3] = torch.nan
    *_, truncated, info = envs.step(asked)
    assert truncated.tolist() == [False, True] and info["truncated_reason"].tolist() == [0, 2]


def test_what_has_no_meaning_is_refused() -> None:
    def refused(match: str, **settings: object) -> None:
        with pytest.raises(ConfigError, match=match):
            make("apcc/Reach-v0", 1, action="pressures", **settings)

    refused("needs an arm with chambers", dynamics="dynamic")
    refused("needs dynamics='dynamic'", arm="soft_trunk")
    with pytest.raises(ConfigError, match="null where it has none"):
        DynamicArm(Arm.load("arm_1"), 0.01, False, LIKE, plant={"arm": {"chambers": {"areas": 1e-4}}})


def pressures(envs_action: Tensor) -> Tensor:
    return Pressing(TRUNK, LIKE).asked(envs_action)


def test_pressures_are_differentiable_in_the_action() -> None:
    action = uniform((2, 6), -1.0, 1.0, torch.float64, generator(3)).requires_grad_()
    (slope,) = torch.autograd.grad(pressures(action).sum(), action)
    torch.testing.assert_close(slope, torch.full_like(slope, 6e4))
