"""The dynamic arm against a plant built for each row alone, and its start against the equation of motion."""

from __future__ import annotations

import torch

from apcc_torch.control.pid import TendonReference
from apcc_torch.envs.dynamic import DynamicArm
from apcc_torch.envs.randomisation import RowParameters
from apcc_torch.envs.row_trees import map_rows
from apcc_torch.model.arm import Arm
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.simulation.plant import Plant
from arm_rows import row_parameters
from laws import generator, uniform

LIKE = torch.empty(0, dtype=torch.float64)
ARM = Arm.load("arm_1")


def varied(n: int) -> RowParameters:
    rng = generator(1)
    return row_parameters(
        n,
        lengths=uniform((n, 3), 0.9, 1.1, torch.float64, rng),
        stiffness=uniform((n,), 0.7, 1.3, torch.float64, rng),
        payload=uniform((n,), 0.0, 0.5, torch.float64, rng),
    )


def alone(rows: RowParameters, i: int) -> Plant:
    """The plant of row i from the paper's numbers, racks at the ends of its own sections."""
    pairs = rows.lengths[i].repeat_interleave(2)
    lengths = ARM.refined(2) * pairs
    dynamics = SoftArmDynamics(
        lengths,
        lengths / lengths.sum(),
        rows.stiffness[i] * 100.0 * 0.1 / lengths,
        rows.stiffness[i] * 0.778 * 0.1 / lengths,
        damping_ratio=0.1,
        base_rotation=ARM.base_rotation(),
    )
    routing = ARM.routing()
    routing.anchors = lengths.cumsum(0)[1::2].repeat_interleave(3)
    return Plant(dynamics, routing, None, rows.payload[i])


def test_rows_are_the_plants_they_would_be_alone() -> None:
    rows = varied(3)
    arm = DynamicArm(ARM, 0.01, True, LIKE, plant={"substeps": 2})
    state = arm.initial(rows)
    y = uniform((3, 9), -0.02, 0.02, torch.float64, generator(2))
    later = arm.step(state, torch.zeros_like(y), y, y, rows)
    for i in range(3):
        plant = alone(rows, i)
        own = map_rows(lambda rows, i=i: rows[i], state)
        for k in (1, 2):
            own = plant.step(own, TendonReference(k * y[i] / 2, y[i] / 0.01), 0.005)
        torch.testing.assert_close(later.arm.q[i], own.arm.q, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(later.z[i], own.z, rtol=1e-9, atol=1e-12)


def test_starts_at_rest() -> None:
    rows = varied(4)
    state = DynamicArm(ARM, 0.01, True, LIKE).initial(rows)
    zero = torch.zeros(9, dtype=torch.float64)
    for i in range(4):
        plant = alone(rows, i)
        own = map_rows(lambda rows, i=i: rows[i], state)
        tau = plant.B @ plant.forces(own, TendonReference(zero, zero))
        qddot = plant.dynamics(*own.arm, tau, plant.payload)
        assert float(qddot.abs().max()) < 1e-9


def test_payload_alone_needs_no_arms_of_their_own() -> None:
    rows = row_parameters(2, payload=torch.tensor([0.0, 0.5], dtype=torch.float64))
    y = torch.full((2, 9), 0.01, dtype=torch.float64)
    one, other = (DynamicArm(ARM, 0.01, varied, LIKE) for varied in (False, True))
    steps = [arm.step(arm.initial(rows), 0 * y, y, y, rows) for arm in (one, other)]
    torch.testing.assert_close(steps[0].arm.q, steps[1].arm.q, rtol=1e-12, atol=1e-14)
    assert float(steps[0].arm.q[1, 2]) > float(steps[0].arm.q[0, 2])  # it hangs lower
