"""The balance of forces on an identified arm, against the model that identifications fit, which is other code."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ShapeError
from apcc_torch.estimation.external_force import BalanceNoise, ForceBalance
from apcc_torch.estimation.posture import Posture, TendonMechanics
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.estimation.weighted_estimate import EstimateStatus
from apcc_torch.identification.arm_blocks import Spreads, arm_parameters, identified_arm
from apcc_torch.identification.tendon_arm import TIP_MASS, Drive, TendonArm
from apcc_torch.lie import so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.friction import elastic_tension
from apcc_torch.model.static_body import StaticBody
from apcc_torch.simulation.sensors import PoseSensors
from identified_arms import SMALL, random_drive
from laws import generator, normal

D = torch.float64
MASSES = torch.tensor([0.0, 0.01, 0.05], dtype=D)


def identified() -> Arm:
    """An arm as a fit might find it: every block off its file, sections unlike, bent at rest, gravity aslant."""
    blocks = arm_parameters(SMALL, Spreads(gravity=2.0, rest_bend=0.3, base_rotation=0.5, pre_stretch=1e-3))
    return identified_arm(SMALL, blocks.values(0.8 * normal((len(blocks),), D, generator(3))))


def seen(arm: Arm, **settings: Any) -> tuple[ForceBalance, Posture]:
    """The balance of an arm, and the arm at rest under `MASSES`, its motors told."""
    drive = random_drive(3, seed=11)
    drive = Drive(drive.history, drive.ages, torch.sign(normal((3, 6), D, generator(5))))
    model, blocks = TendonArm(arm), arm_parameters(arm, Spreads())
    values = blocks.values(blocks.nominal())
    q = torch.cat([
        model.rest(drive.rows(slice(k, k + 1)), values | {TIP_MASS: MASSES[k : k + 1]}, iterations=200)
        for k in range(3)
    ])  # fmt: skip
    assert bool(q.isfinite().all())
    backbone = arm.backbone()
    feedback = StateFeedback(backbone, arm.sensor_places(), angular_weight=0.03, max_iterations=60)
    balance = ForceBalance(
        StaticBody.of(arm, backbone), arm.routing(), feedback, mechanics=TendonMechanics.of(arm), **settings
    )
    pulled = arm.actuation.pulled(drive.history[:, 0], arm.n_tendons)
    return balance, Posture(q, arm.rest_lengths().expand(3, 2), None, pulled=pulled, slide=drive.slide)


def test_its_payload_is_weighed_from_motors_and_shape() -> None:
    balance, posture = seen(identified())
    # Mass points, four a section there and three here, agree to a millionth.
    assert float(balance.imbalance(posture._replace(payload=MASSES)).abs().max()) < 1e-6
    found = balance.payload(posture)
    assert (found.status == EstimateStatus.DETERMINED).all()
    torch.testing.assert_close(found.value[:, 0], MASSES, rtol=1e-4, atol=1e-6)
    weight = balance.force(posture)
    torch.testing.assert_close(weight.value[:, 2], -identified().placement.acceleration * MASSES, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("left", ["friction", "rest_bend", "pre_stretch", "slack", "sections"])
def test_nothing_of_it_may_be_left_out(left: str) -> None:
    """Each part of the mechanics, taken away, spoils the payload: the test above does not pass by their being nil."""
    arm = identified()
    balance, posture = seen(arm)
    mechanics, body = TendonMechanics.of(arm), balance.body
    pulled = posture.pulled
    assert pulled is not None
    if left == "friction":
        posture = posture._replace(slide=None)
    elif left == "rest_bend":
        body = StaticBody.of(arm.changed(rest_bend=None), arm.backbone())
    elif left == "pre_stretch":
        posture = posture._replace(pulled=pulled - torch.tensor(arm.actuation.pre_stretch, dtype=D))
    elif left == "slack":
        y = posture.q_bar @ arm.routing().matrix(arm.rest_lengths())
        posture = posture._replace(u=-mechanics.stiffness * (pulled + y))
    else:
        EI = sum(torch.tensor(arm.bending_rigidity, dtype=D).tolist()) / 2.0
        body = StaticBody.of(arm.changed(bending_rigidity=EI), arm.backbone())
    spoilt = ForceBalance(body, arm.routing(), balance.feedback, mechanics=mechanics)
    assert float((spoilt.payload(posture).value[:, 0] - MASSES).abs().max()) > 2e-4


def test_its_deviation_holds_what_stretching_tendons_make_of_the_sensors_noise() -> None:
    noise = BalanceNoise(position=1e-5, angle=2e-4, tension=1e-4, bend=1e-7, length=1e-5)
    arm = identified()
    balance, posture = seen(arm, noise=noise)
    one = Posture(*(None if part is None else part[2:].expand(300, part.shape[-1]) for part in posture))
    X = arm.sensor_places()
    T = arm.backbone().pose(one.q_bar, one.pi_hat, *decouple(X.expand(300, 2), one.pi_hat))
    sensors = PoseSensors(1e-5, 2e-4)
    measured = sensors(sensors.initial_state(T), T, generator(8))[1]
    q_bar = balance.feedback(one.q_bar, arm.rest_lengths(), measured).q_bar
    found = balance.payload(one._replace(q_bar=q_bar))
    off = (found.value[:, 0] - MASSES[2]) / found.covariance[:, 0, 0].sqrt()
    assert 0.85 < float(off.square().mean().sqrt()) < 1.15


def test_elastic_tension_is_the_slope_of_its_energy() -> None:
    """k s^2 / 2 where taut and nothing where slack, rounded: by its own integral, written out."""
    s = torch.tensor([-3e-3, -1e-6, 0.0, 2e-6, 4e-3], dtype=D, requires_grad=True)
    k, c = torch.tensor(2500.0, dtype=D), 1e-5
    root = torch.sqrt(s * s + c * c)
    energy = 0.25 * k * (s * s + s * root + c * c * torch.asinh(s / c))
    (slope,) = torch.autograd.grad(energy.sum(), s)
    torch.testing.assert_close(elastic_tension(s, k).detach(), slope, rtol=1e-9, atol=1e-9)
    assert elastic_tension(s, k)[-1].item() == pytest.approx(10.0, rel=1e-4)


def test_what_is_missing_or_does_not_fit_is_named() -> None:
    arm = identified()
    balance, posture = seen(arm)
    bare = ForceBalance(balance.body, arm.routing(), balance.feedback)
    with pytest.raises(ConfigError, match=r"posture\.pulled needs mechanics"):
        bare.payload(posture._replace(slide=None))
    with pytest.raises(ShapeError, match="bending"):
        StaticBody(arm.backbone(), torch.ones(2), torch.ones(2), torch.ones(3), per_section=True)


def test_of_one_material_both_ways_are_the_same() -> None:
    arm = Arm(lengths=[0.2, 0.25], mass=0.9)
    told, uniform = StaticBody.of(arm, arm.backbone()), StaticBody(arm.backbone(), 2.0, 10.0, 0.0778)
    q: Tensor = 0.2 * normal((4, 6), D, generator(1))
    pi_hat = torch.tensor([0.18, 0.27], dtype=D)
    torch.testing.assert_close(told.rest_force(q, pi_hat), uniform.rest_force(q, pi_hat))
    turned = so3.exp(torch.tensor([0.0, 0.0, 0.4], dtype=D)) @ arm.base_rotation()
    about = StaticBody(type(arm.backbone())(2, turned), 2.0, 10.0, 0.0778)
    torch.testing.assert_close(about.rest_force(q, pi_hat), uniform.rest_force(q, pi_hat))
