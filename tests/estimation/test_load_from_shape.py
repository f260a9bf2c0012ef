"""Loads from shapes under tendons of known length: exact on the model's own arm, blind where the lengths say it all."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.load_from_shape import LoadFromShape, ShapeNoise
from apcc_torch.estimation.weighted_estimate import EstimateStatus
from apcc_torch.simulation.sensors import PoseSensors
from arms import PI
from laws import bits, generator, normal
from resting_arms import RACKS, ROUTING, Resting, arm, at_rest

D = torch.float64
SIX = torch.tensor([0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12], dtype=D)
FOUR = torch.tensor([0.105, 0.1275, 0.1275, 0.24], dtype=D)
PAYLOAD = torch.tensor([0.0, 0.1, 0.4], dtype=D)
FORCES = torch.tensor([[0.5, 0.0, 0.2], [0.0, -1.0, 0.4], [-0.3, 0.6, -1.0]], dtype=D)
GIVEN = {"shape": (True, False), "tensions": (False, True), "both": (True, True)}


def given(rest: Resting, name: str) -> dict[str, Any]:
    shape, tensions = GIVEN[name]
    return {"T": rest.T if shape else None, "u": rest.u if tensions else None}


@pytest.mark.parametrize("name", list(GIVEN))
def test_a_payload_and_a_force_are_found(name: str) -> None:
    rest = at_rest(3, PAYLOAD, SIX)
    found = LoadFromShape(arm(SIX), ROUTING, RACKS)(rest.y, **given(rest, name))
    assert bool(found.converged.all()) and (found.load.status == EstimateStatus.DETERMINED).all()
    torch.testing.assert_close(found.load.value[:, 0], PAYLOAD, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found.q, rest.q, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(found.u, rest.u, rtol=0.0, atol=1e-3)
    rest = at_rest(3, None, SIX, force=FORCES)
    # What the shape tells of a vertical force on an arm that hangs is little: some 10 N at these sensors' noise.
    found = LoadFromShape(arm(SIX), ROUTING, RACKS, "force", limit=50.0)(rest.y, **given(rest, name))
    torch.testing.assert_close(found.load.value, FORCES, rtol=1e-3, atol=1e-4)


def test_lengths_that_say_the_whole_shape_leave_nothing_for_the_load() -> None:
    """Nine inextensible tendons on nine coordinates: the shape does not depend on the load."""
    rest = at_rest(3, PAYLOAD)
    blind = LoadFromShape(arm(PI), ROUTING, RACKS)(rest.y, T=rest.T)
    assert (blind.load.status == EstimateStatus.UNDETERMINED).all() and bool(blind.load.value.isnan().all())
    pulled = LoadFromShape(arm(PI), ROUTING, RACKS)(rest.y, u=rest.u)
    torch.testing.assert_close(pulled.load.value[:, 0], PAYLOAD, rtol=1e-4, atol=1e-5)


def test_its_deviation_is_the_spread_under_noise() -> None:
    rest = at_rest(1, PAYLOAD[2:], FOUR)
    noise = ShapeNoise(position=5e-4, angle=5e-3, length=1e-4, tension=0.1)
    count = 150
    sensors = PoseSensors(5e-4, 5e-3)
    T = rest.T.expand(count, 3, 4, 4)
    seen = sensors(sensors.initial_state(T), T, generator(1))[1]
    y = rest.y + 1e-4 * normal((count, 9), D, generator(2))
    u = rest.u + 0.1 * normal((count, 9), D, generator(3))
    h = LoadFromShape(arm(FOUR), ROUTING, RACKS, noise=noise, iterations=3)
    deviations = {}
    for name, readings in {"shape": (seen, None), "tensions": (None, u), "both": (seen, u)}.items():
        load = h(y, *readings).load
        spread = float(((load.value[:, 0] - PAYLOAD[2]) ** 2).mean().sqrt())
        deviations[name] = float(load.deviation.mean())
        assert 0.8 < spread / deviations[name] < 1.2, name
    assert deviations["both"] < min(deviations["shape"], deviations["tensions"])


def test_a_sensor_left_out_or_lost_does_not_count() -> None:
    rest = at_rest(2, PAYLOAD[1:], SIX)
    h = LoadFromShape(arm(SIX), ROUTING, RACKS)
    lost = rest.T.clone()
    lost[:, 1] = torch.nan
    wrong = rest.T.clone()
    wrong[:, 1, :3, 3] += 0.1
    mask = torch.tensor([True, False, True])
    a, b = h(rest.y, lost), h(rest.y, wrong, mask=mask)
    assert torch.equal(bits(a.load.value), bits(b.load.value))
    torch.testing.assert_close(a.load.value[:, 0], PAYLOAD[1:], rtol=1e-3, atol=1e-4)


def test_bad_rows_stay_alone() -> None:
    rest = at_rest(3, PAYLOAD, SIX)
    h = LoadFromShape(arm(SIX), ROUTING, RACKS)
    bad = rest.y.clone()
    bad[0] = torch.nan
    found = h(bad, rest.T, rest.u)
    assert found.load.status[0] == EstimateStatus.INVALID and not bool(found.converged[0])
    torch.testing.assert_close(found.load.value[1:, 0], PAYLOAD[1:], rtol=1e-4, atol=1e-5)


def test_bad_input_is_named() -> None:
    h = LoadFromShape(arm(SIX), ROUTING, RACKS)
    with pytest.raises(ConfigError, match="poses T, tendon forces u"):
        h(torch.zeros(9, dtype=D))
    with pytest.raises(ConfigError, match="unknown must be"):
        LoadFromShape(arm(SIX), ROUTING, RACKS, "torque")
    with pytest.raises(ValueRangeError, match=r"noise\.tension"):
        LoadFromShape(arm(SIX), ROUTING, RACKS, noise=ShapeNoise(tension=0.0))
