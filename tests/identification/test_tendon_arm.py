"""The arm at rest: its weight, its equilibrium, slack tendons and derivatives, each against something independent."""

from __future__ import annotations

import torch

from apcc_torch.identification.arm_blocks import Spreads, arm_parameters
from apcc_torch.identification.fit import sensitivity
from apcc_torch.identification.tendon_arm import TIP_MASS, Drive, TendonArm
from apcc_torch.lie import so3
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.arm_tendons import Actuation, Tendons
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.statics import equilibrium
from apcc_torch.model.tendons import TendonRouting
from identified_arms import SMALL, parameters, random_drive


def _dynamics(arm: TendonArm, values: dict[str, torch.Tensor]) -> SoftArmDynamics:
    K = arm.stiffness(values).unflatten(0, (-1, 3))
    R = so3.exp(values["base_rotation"])
    return SoftArmDynamics(values["rest_length"], arm.masses, K[:, 2], K[:, 0], base_rotation=R, n_quadrature=3)


def test_weight_is_that_of_the_dynamics() -> None:
    arm, values = TendonArm(SMALL), parameters().values(parameters().nominal())
    values["base_rotation"] = torch.tensor([2.4, -0.5, 0.3], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([1.0, 1.0, 0.01], dtype=torch.float64).repeat(2)
    q = torch.randn(20, 6, generator=generator, dtype=torch.float64) * scale
    torch.testing.assert_close(arm.weight(q, values), -_dynamics(arm, values).gravity(q), rtol=1e-9, atol=1e-12)
    loaded = arm.weight(q, values | {TIP_MASS: torch.tensor([0.3], dtype=torch.float64)})
    torch.testing.assert_close(loaded, -_dynamics(arm, values).static_load(q, 0.3), rtol=1e-9, atol=1e-12)


def test_rest_of_taut_tendons_is_the_equilibrium_of_statics() -> None:
    blocks = parameters()
    arm, values = TendonArm(SMALL), blocks.values(blocks.nominal())
    values["friction"] = torch.zeros(1, dtype=torch.float64)
    values["pre_stretch"] = torch.full((6,), 8e-3, dtype=torch.float64)  # so taut that no tendon ever slackens
    drive = random_drive(12, seed=1, reach=0.8)
    q = arm.rest(drive, values)
    routing = TendonRouting(values["angle"], values["offset"], torch.tensor([0.1] * 3 + [0.2] * 3, dtype=torch.float64))
    there = equilibrium(
        _dynamics(arm, values), routing=routing, tendon_lengths=-arm.pulled(drive, values), compliance=1.0 / 3000.0
    )
    assert bool(there.converged.all())
    assert there.u is not None and bool((there.u < 0).all())
    torch.testing.assert_close(q, there.q, rtol=1e-5, atol=1e-7)


def test_a_slack_tendon_pushes_nothing() -> None:
    blocks = parameters()
    arm, values = TendonArm(SMALL), blocks.values(blocks.nominal())
    inputs = torch.tensor([[3.0, -6.0, -6.0, -6.0, -6.0, -6.0], [3.0, -30.0, -30.0, -30.0, -30.0, -30.0]])
    inputs = inputs.to(torch.float64)
    drive = Drive(inputs.unsqueeze(1), torch.zeros(2, 1, dtype=torch.float64), torch.zeros_like(inputs))
    bodies = arm.predict(drive, values)
    torch.testing.assert_close(bodies[0], bodies[1], rtol=0.0, atol=2e-6)
    # The pulled tendon lies at angle 0: in its own axes the arm bends towards +x.
    local = (bodies[0, 1] - values["base_position"]) @ so3.exp(values["base_rotation"])
    assert float(local[0]) > 0.02 > abs(float(local[1]))


def test_geometry_keeps_every_tendon_at_its_length() -> None:
    blocks = parameters()
    arm, values = TendonArm(SMALL, kinematic=True), blocks.values(blocks.nominal())
    bends = torch.tensor([[0.4, -0.2, 0.0, -0.3, 0.5, 0.0]], dtype=torch.float64)
    q = arm.bends(-bends @ arm.matrix(values), values)
    torch.testing.assert_close(q, bends)


def test_friction_resists_the_way_a_tendon_moves() -> None:
    blocks = parameters()
    arm, values = TendonArm(SMALL), blocks.values(blocks.nominal())
    drive = random_drive(1, seed=3)._replace(history=torch.tensor([[[3.0, -1, -1, -1, -1, -1]]], dtype=torch.float64))
    slides = {way: torch.full((1, 6), way, dtype=torch.float64) for way in (-1.0, 0.0, 1.0)}
    bend = {way: float(arm.rest(drive._replace(slide=s), values)[0, 0]) for way, s in slides.items()}
    assert bend[1.0] < bend[0.0] < bend[-1.0]


def test_lag_weighs_the_past_as_a_first_order_filter_does() -> None:
    blocks = parameters()
    arm, values = TendonArm(SMALL), blocks.values(blocks.nominal())
    values |= {"damping_ratio": torch.tensor([0.05], dtype=torch.float64), "pre_stretch": torch.zeros(6).double()}
    ages = 0.01 * torch.arange(60, dtype=torch.float64)
    step = (ages < 0.2).to(torch.float64).reshape(1, 60, 1).expand(1, 60, 6)  # turned on 20 samples ago
    pulled = arm.pulled(Drive(step, ages.unsqueeze(0), torch.zeros(1, 6).double()), values)
    torch.testing.assert_close(
        pulled, torch.full((1, 6), 1e-3).double() * (1.0 - torch.exp(torch.tensor(-4.0).double()))
    )


def test_derivative_by_the_parameters_is_that_of_differences() -> None:
    blocks = parameters(offset=0.1, pre_stretch=1e-3, bending_rigidity=0.3, gravity=1.0, friction=0.5, mount=1e-3)
    arm, drive, z = TendonArm(SMALL), random_drive(5, seed=2), blocks.nominal()
    drive = drive._replace(slide=torch.sign(drive.history[:, 0]))
    q = arm.rest(drive, blocks.values(z))
    slope = arm.resting_slope(drive, blocks.values(z), q)
    J = torch.func.jacfwd(lambda at: arm.positions(drive, blocks.values(at), q, slope))(z)
    torch.testing.assert_close(sensitivity(arm, blocks, drive, z, q), J, rtol=1e-5, atol=1e-7)
    step = 1e-5 * torch.eye(len(z), dtype=z.dtype)
    for k in range(0, len(z), 3):
        ahead, behind = (arm.predict(drive, blocks.values(z + sign * step[k])) for sign in (1.0, -1.0))
        torch.testing.assert_close(J[..., k], (ahead - behind) / 2e-5, rtol=2e-4, atol=2e-8)


def test_sensors_inside_sections_lie_on_the_backbone() -> None:
    blocks = parameters()
    inside = TendonArm(SMALL.changed(sensors=[0.05, 0.1, 0.16, 0.2]))
    assert not inside.at_tips
    values = blocks.values(blocks.nominal()) | {"mount": torch.zeros(12).double()}
    drive = random_drive(4, seed=8)
    bodies = inside.predict(drive, values)
    tips = TendonArm(SMALL).predict(drive, blocks.values(blocks.nominal()))
    torch.testing.assert_close(bodies[:, [1, 3]], tips, rtol=0.0, atol=1e-12)
    q, R = inside.rest(drive, values), so3.exp(values["base_rotation"])
    points = SMALL.backbone().points(q, SMALL.rest_lengths(), 401, "material") @ (R @ SMALL.base_rotation().mT).mT
    torch.testing.assert_close(bodies[:, [0, 2]], points[:, [100, 320]], rtol=0.0, atol=1e-5)


def test_the_model_of_the_arm_rests_as_the_identified_one_does() -> None:
    # Gravity askew in the recording's frame, an arm turned there, tendons and sections told one by one.
    arm = SMALL.changed(
        placement=Placement(position=(0.1, 0.2, 0.3), rotation=(2.0, -0.7, 0.4), gravity=(3.0, -9.0, 1.0)),
        tendons=Tendons(angles=(0.1, 2.0, 4.0, 5.0), offsets=(5e-3, 6e-3, 7e-3, 5e-3), ends=(2, 1, 1, 2)),
        actuation=Actuation(pulls=1e-3, pre_stretch=8e-3),
        masses=(0.03, 0.01),
        bending_rigidity=(1e-3, 2e-3),
    )
    model, blocks = TendonArm(arm), arm_parameters(arm, Spreads(friction=0.0))
    values = blocks.values(blocks.nominal())
    drive = random_drive(6, seed=1, reach=0.8)._replace(slide=torch.zeros(6, 4).double())
    q = model.rest(drive, values)
    there = equilibrium(
        arm.dynamics(), routing=arm.routing(), tendon_lengths=-model.pulled(drive, values), compliance=1.0 / 3000.0
    )
    assert bool(there.converged.all())
    # They differ by the rounded corner at which a tendon goes slack.
    torch.testing.assert_close(q, there.q, rtol=1e-4, atol=1e-5)
    # The world of the dynamics differs from the recording's frame by a rotation that turns gravity downwards, and by
    # the base's place.
    tips = arm.backbone().tip(q, arm.rest_lengths())
    local = (model.predict(drive, values)[:, -1] - values["base_position"]) @ arm.placement.upright().mT
    torch.testing.assert_close(tips, local, rtol=0.0, atol=1e-12)
