"""Wrenches at any place against virtual work, and a problem turned as a whole: base, gravity and wrench together."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ShapeError
from apcc_torch.lie import so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm import Arm
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.arm_placement import Placement
from apcc_torch.model.loads import Loads
from apcc_torch.model.rod_dynamics import RodDynamics
from apcc_torch.model.statics import equilibrium, load_stiffness
from laws import generator, normal

D = torch.float64
PLACES = torch.tensor([0.03, 0.1, 0.17, 0.3], dtype=D)


def sections() -> ArmDynamics:
    return Arm(lengths=[0.1, 0.12, 0.08], mass=0.3, placement=Placement(gravity=(3.0, -4.0, 7.0))).dynamics()


def elements() -> ArmDynamics:
    lengths = torch.tensor([0.1, 0.12, 0.08], dtype=D)
    bending, shear = 0.05 / lengths, 30.0 / lengths
    base = so3.exp(torch.tensor([0.4, 0.9, -0.3], dtype=D))
    return RodDynamics(lengths, lengths, shear, bending, bending, shear, radius=0.01, base_rotation=base)


MODELS = pytest.mark.parametrize("arm", [sections(), elements()], ids=["sections", "rod"])


def poses(arm: ArmDynamics, q: Tensor) -> Tensor:
    """World poses (p, 4, 4) of the places."""
    return arm.kinematics().pose(q, arm.lengths, *decouple(PLACES, arm.lengths))


def work(arm: ArmDynamics, q: Tensor, wrenches: Tensor) -> Tensor:
    """Virtual work (n,) per unit of each coordinate, by central differences of the places' poses."""
    h, columns = 1e-6, []
    for e in torch.eye(arm.n, dtype=D):
        ahead, behind, now = (poses(arm, q + side * h * e) for side in (1.0, -1.0, 0.0))
        rate = (ahead - behind) / (2.0 * h)
        turn = rate[:, :3, :3] @ now[:, :3, :3].mT
        spin = torch.stack((turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]), dim=-1)
        columns.append((wrenches * torch.cat((spin, rate[:, :3, 3]), dim=-1)).sum())
    return torch.stack(columns)


@MODELS
def test_wrenches_at_any_place_do_the_work_of_their_places(arm: ArmDynamics) -> None:
    q, w = 0.2 * normal((arm.n,), D, generator(0)), normal((4, 6), D, generator(1))
    q[2::3] *= 0.05
    placed = Loads(places=PLACES, place_wrenches=w)
    own = arm.gravity(q) - arm.static_load(q, None, *placed)
    torch.testing.assert_close(own, work(arm, q, w), rtol=1e-7, atol=1e-8)
    # A force that keeps its direction has a potential: in motion it adds to the bias what it adds at rest.
    still, rates = torch.zeros_like(q), normal((arm.n,), D, generator(2))
    for qdot in (still, rates):
        bare = arm.equation(q, qdot, 0.1).bias - arm.equation(q, qdot, 0.1, places=PLACES, place_wrenches=w).bias
        torch.testing.assert_close(bare, own, rtol=1e-9, atol=1e-11)
    pushed = arm.forward(q, still, still, 0.1, places=PLACES, place_wrenches=w)
    torch.testing.assert_close(pushed, arm.forward(q, still, own, 0.1), rtol=1e-8, atol=1e-9)


@MODELS
def test_what_acts_at_a_sections_tip_may_be_said_either_way(arm: ArmDynamics) -> None:
    q, w = 0.1 * normal((2, arm.n), D, generator(3)), normal((2, 3, 6), D, generator(4))
    tips = arm.lengths.cumsum(-1)
    there = arm.static_load(q, section_wrenches=w)
    torch.testing.assert_close(arm.static_load(q, places=tips, place_wrenches=w), there, rtol=1e-10, atol=1e-12)
    alone = arm.static_load(q[1], places=tips, place_wrenches=w[1])
    torch.testing.assert_close(alone, there[1], rtol=1e-10, atol=1e-12)
    at_tip = arm.static_load(q, wrench=w[:, 2])
    torch.testing.assert_close(
        arm.static_load(q, places=tips[2:], place_wrenches=w[:, 2:]), at_tip, rtol=1e-10, atol=1e-12
    )


@MODELS
def test_rest_under_placed_wrenches_is_balanced_and_its_slope_is_right(arm: ArmDynamics) -> None:
    w = 0.05 * normal((3, 4, 6), D, generator(5))
    loads = Loads(places=PLACES, place_wrenches=w)
    found = equilibrium(arm, payload=0.02, loads=loads)
    assert bool(found.converged.all())
    held = torch.stack([work(arm, q, own) for q, own in zip(found.q, w, strict=True)])
    left = arm.stiffness_diagonal * found.q + arm.gravity(found.q, 0.02) - held
    assert float(left.abs().max()) < 1e-8
    h, (_, slope) = 1e-6, load_stiffness(arm, found.q[0], 0.02, Loads(places=PLACES, place_wrenches=w[0]))
    step = h * torch.eye(arm.n, dtype=D)
    ahead, behind = (arm.static_load(found.q[0] + s * step, 0.02, places=PLACES, place_wrenches=w[0]) for s in (1, -1))
    torch.testing.assert_close(slope, ((ahead - behind) / (2.0 * h)).mT, rtol=1e-6, atol=1e-7)


def test_base_gravity_and_wrenches_turned_together_leave_the_shape() -> None:
    turn = so3.exp(torch.tensor([0.7, -1.1, 2.0], dtype=D))
    rotation, gravity = torch.tensor([0.3, 0.8, -0.5], dtype=D), torch.tensor([2.0, -5.0, 8.0], dtype=D)
    w = 0.2 * normal((4, 2, 3), D, generator(6))
    answers = []
    for Q in (torch.eye(3, dtype=D), turn):
        there = Placement(
            rotation=tuple(so3.log(Q @ so3.exp(rotation)).tolist()), gravity=tuple((Q @ gravity).tolist())
        )
        arm = Arm(lengths=[0.1, 0.12, 0.08], mass=0.3, placement=there)
        wrenches = (w @ (there.upright() @ Q).mT).flatten(-2)  # torque and force, in the axes of the dynamics
        loads = Loads(places=PLACES, place_wrenches=wrenches)
        rest = equilibrium(arm.dynamics(), payload=0.05, loads=loads)
        assert bool(rest.converged)
        moving = arm.dynamics()(rest.q + 0.1, rest.q, rest.q, 0.05, places=PLACES, place_wrenches=wrenches)
        tip = there.upright().mT @ arm.backbone().tip(rest.q, arm.rest_lengths())
        answers.append((rest.q, moving, Q.mT @ tip))
    for one, other in zip(*answers, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-9)
    assert float(answers[0][0].abs().max()) > 0.02


def test_places_and_wrenches_belong_together() -> None:
    arm, q = sections(), torch.zeros(9, dtype=D)
    for half in (Loads(places=PLACES), Loads(place_wrenches=torch.zeros(4, 6, dtype=D))):
        with pytest.raises(ConfigError, match="give both, or neither"):
            arm.static_load(q, None, *half)
    with pytest.raises(ShapeError, match="place_wrenches"):
        arm.static_load(q, places=PLACES, place_wrenches=torch.zeros(3, 6, dtype=D))
