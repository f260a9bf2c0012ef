"""Equilibria against closed forms, Euler's elastica, and another simulator's Cosserat rod."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, ShapeError
from apcc_torch.model.arc import arc_pose
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.loads import Loads
from apcc_torch.model.statics import equilibrium, load_stiffness
from apcc_torch.model.tendons import rack_routing
from laws import check_gradients, generator, normal
from skips import no_recording

D = torch.float64
RACKS = torch.tensor([0.105, 0.36, 0.60], dtype=D)


def rod(
    n_b: int, length: float, axial: float, bending: float, mass: float = 1e-3, gravity: float = 0.0
) -> SoftArmDynamics:
    """A uniform rod of axial stiffness EA (N) and bending stiffness EI (N m^2) in n_b sections, along world z."""
    one = torch.full((n_b,), length / n_b, dtype=D)
    return SoftArmDynamics(one, one * mass / length, axial / one, bending / one, gravity=gravity)


def plant() -> SoftArmDynamics:
    lengths = torch.tensor([0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12], dtype=D)
    base = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=D))
    return SoftArmDynamics(lengths, lengths / 0.6, 10.0 / lengths, 0.0778 / lengths, base_rotation=base)


def section_tips(arm: SoftArmDynamics, q: Tensor) -> Tensor:
    """World positions (n_b, 3) of the section tips."""
    rotation, base, found = arm.base_rotation, torch.zeros(3, dtype=D), []
    for (x, y, stretch), length in zip(q.unflatten(-1, (-1, 3)), arm.lengths, strict=True):
        turn, chord = arc_pose(x, y)
        base = base + (length + stretch) * rotation @ chord
        rotation = rotation @ turn
        found.append(base)
    return torch.stack(found)


def wrench(*values: float) -> Tensor:
    return torch.tensor(values, dtype=D)


def test_axial_force_stretches_by_hookes_law() -> None:
    arm = rod(3, 0.6, 50.0, 0.1)
    result = equilibrium(arm, loads=Loads(wrench(0, 0, 0, 0, 0, 4.0)))
    want = torch.tensor([0.0, 0.0, 4.0 * 0.2 / 50.0] * 3, dtype=D)
    torch.testing.assert_close(result.q, want)
    assert bool(result.converged) and result.u is None


def test_tip_moment_bends_into_a_circle() -> None:
    arm = rod(3, 0.6, 50.0, 0.1)
    moment = 0.3
    result = equilibrium(arm, loads=Loads(wrench(0, moment, 0, 0, 0, 0)))
    # Curvature M / EI, exact for constant curvature: a full turn of M L / EI = 1.8 rad.
    want = torch.tensor([moment * 0.2 / 0.1, 0.0, 0.0] * 3, dtype=D)
    torch.testing.assert_close(result.q, want, rtol=1e-9, atol=1e-10)
    angle = moment * 0.6 / 0.1
    tip = 0.6 / angle * torch.tensor([1 - math.cos(angle), 0.0, math.sin(angle)], dtype=D)
    torch.testing.assert_close(section_tips(arm, result.q)[-1], tip, rtol=1e-8, atol=1e-9)


def test_hanging_weight() -> None:
    arm = plant()
    payload = torch.tensor([0.0, 0.5], dtype=D)
    result = equilibrium(arm, payload=payload)
    stretch = result.q.unflatten(-1, (6, 3))[..., 2]
    # Each section carries what is beyond it and half of its own weight.
    beyond = arm.masses.flip(0).cumsum(0).flip(0) - 0.5 * arm.masses
    want = 9.81 * (beyond + payload[:, None]) / arm.stiffness_diagonal[2::3]
    torch.testing.assert_close(stretch, want)


def test_elastica() -> None:
    solve_bvp = pytest.importorskip("scipy.integrate").solve_bvp
    length, bending, force = 0.5, 0.05, 0.8  # F L^2 / EI = 4
    # EI theta'' = -F cos(theta), theta(0) = 0, theta'(L) = 0; the load pushes along x, the rod starts along z.
    s = np.linspace(0, length, 200)
    exact = solve_bvp(
        lambda s, v: np.stack((v[1], -force / bending * np.cos(v[0]), np.sin(v[0]), np.cos(v[0]))),
        lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
        s, np.zeros((4, s.size)), tol=1e-10, max_nodes=20000,
    )  # fmt: skip
    tip = torch.tensor([exact.y[2, -1], 0.0, exact.y[3, -1]], dtype=D)
    errors = []
    for n_b in (8, 16):
        arm = rod(n_b, length, 1e5, bending)
        result = equilibrium(arm, loads=Loads(wrench(0, 0, 0, force, 0, 0)))
        assert bool(result.converged)
        errors.append(float((section_tips(arm, result.q)[-1] - tip).norm()))
    # Piecewise constant curvature converges with the square of the section length.
    assert errors[1] < 6e-4 and 3.4 < errors[0] / errors[1] < 4.6


def test_own_weight_is_a_distributed_load() -> None:
    arm, weightless = rod(4, 0.4, 20.0, 0.05, mass=0.3, gravity=9.81), rod(4, 0.4, 20.0, 0.05, mass=0.3)
    side = torch.tensor([0.1, 0, 0] * 4, dtype=D)
    heavy = equilibrium(arm, side)
    loaded = equilibrium(weightless, side, loads=Loads(distributed=torch.tensor([0, 0, -0.3 * 9.81 / 0.4], dtype=D)))
    torch.testing.assert_close(heavy.q, loaded.q, rtol=1e-8, atol=1e-9)


def test_section_wrench_at_the_tip_is_a_tip_wrench() -> None:
    arm = plant()
    w = torch.tensor([0.02, -0.03, 0.01, 0.3, 0.2, -0.4], dtype=D)
    everywhere = torch.zeros(6, 6, dtype=D)
    everywhere[-1] = w
    q = 0.1 * normal((18,), D, generator(0))
    at_tip = arm.static_load(q, None, w)
    torch.testing.assert_close(arm.static_load(q, section_wrenches=everywhere), at_tip, rtol=1e-12, atol=1e-14)
    # One section of many: the work of its force over its tip's displacement.
    everywhere = torch.zeros(6, 6, dtype=D)
    everywhere[2, 3:] = w[3:]
    columns = torch.autograd.functional.jacobian(lambda v: section_tips(arm, v)[2], q)
    work = arm.gravity(q) - arm.static_load(q, section_wrenches=everywhere)
    torch.testing.assert_close(work, w[3:] @ columns, rtol=1e-10, atol=1e-12)


def test_load_stiffness_against_finite_differences() -> None:
    arm = plant()
    q = 0.2 * normal((2, 18), D, generator(1))
    loads = Loads(wrench(0.01, 0.02, -0.01, 0.3, -0.2, 0.1), wrench(0.1, 0.2, 0.3))
    value, slope = load_stiffness(arm, q, 0.3, loads)
    torch.testing.assert_close(value, arm.static_load(q, 0.3, *loads))
    h = 1e-6
    columns = [
        (arm.static_load(q + h * e, 0.3, *loads) - arm.static_load(q - h * e, 0.3, *loads)) / (2 * h)
        for e in torch.eye(18, dtype=D)
    ]
    torch.testing.assert_close(slope, torch.stack(columns, -1), rtol=1e-6, atol=1e-7)


def test_tensions_and_lengths_are_two_views_of_one_equilibrium() -> None:
    arm, routing = plant(), rack_routing(RACKS)
    tensions = 1.2 * torch.rand(5, 9, dtype=D, generator=generator(2))
    payload = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.5], dtype=D)
    pulled = equilibrium(arm, routing=routing, tensions=tensions, payload=payload)
    assert bool(pulled.converged.all()) and pulled.u is not None
    torch.testing.assert_close(pulled.u, -tensions)
    balance = arm.stiffness_diagonal * pulled.q + arm.gravity(pulled.q, payload)
    torch.testing.assert_close(balance, routing.generalized_force(pulled.u, arm.lengths), rtol=1e-8, atol=1e-9)
    y = routing.lengths(pulled.q, arm.lengths)
    held = equilibrium(arm, routing=routing, tendon_lengths=y, payload=payload)
    assert bool(held.converged.all()) and held.u is not None
    torch.testing.assert_close(held.q, pulled.q, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(held.u, -tensions, rtol=1e-6, atol=1e-6)
    # A tendon that stretches needs more length change at the motor for the same force.
    elastic = equilibrium(
        arm, routing=routing, tendon_lengths=y - 1e-3 * tensions, payload=payload, compliance=1e-3
    )  # fmt: skip
    torch.testing.assert_close(elastic.q, pulled.q, rtol=1e-6, atol=1e-8)


def test_rows_do_not_mix_and_bad_rows_stay_alone() -> None:
    arm = plant()
    tau = 0.2 * normal((4, 18), D, generator(3))
    bad = tau.clone()
    bad[1] = torch.nan
    good_result, bad_result = equilibrium(arm, tau), equilibrium(arm, bad)
    others = [0, 2, 3]
    assert torch.equal(good_result.q[others], bad_result.q[others])
    assert bad_result.converged.tolist() == [True, False, True, True]
    torch.testing.assert_close(equilibrium(arm, tau[2]).q, good_result.q[2], rtol=1e-9, atol=1e-10)


def test_a_section_that_is_pressed_through_nothing_is_at_no_rest() -> None:
    arm = rod(3, 0.6, 50.0, 0.1)
    result = equilibrium(arm, loads=Loads(torch.tensor([[0.0, 0, 0, 0, 0, -45.0], [0.0, 0, 0, 0, 0, -55.0]], dtype=D)))
    lengths = 0.2 + result.q[:, 2::3]
    assert (lengths[0] > 0.0).all() and (lengths[1] < 0.0).all(), "Hooke's law knows no end"
    assert result.converged.tolist() == [True, False]


def test_equilibrium_is_differentiable() -> None:
    arm, routing = plant(), rack_routing(RACKS)
    tensions = torch.linspace(1.0, 5.0, 9, dtype=D)

    def op(pull: Tensor, payload: Tensor) -> Tensor:
        return equilibrium(arm, routing=routing, tensions=pull, payload=payload, tolerance=1e-13).q

    check_gradients(op, tensions, torch.tensor(0.2, dtype=D), second=False)


def test_bad_input_is_named() -> None:
    arm, routing = plant(), rack_routing(RACKS)
    one = torch.ones(9, dtype=D)
    with pytest.raises(ConfigError, match="not both"):
        equilibrium(arm, routing=routing, tensions=one, tendon_lengths=one)
    with pytest.raises(ConfigError, match="routing"):
        equilibrium(arm, tensions=one)
    with pytest.raises(ShapeError, match="tensions"):
        equilibrium(arm, routing=routing, tensions=one[:3])


def test_cosserat_rod_of_another_simulator(shared_data: Path) -> None:
    path = shared_data / "sorosim_statics" / "TPURod_statics.csv"
    if not path.is_file():
        no_recording(str(path))
    with path.open() as file:
        rows = list(csv.reader(file))[2:]
    count, n_b, length, radius = 24, 20, 0.4, 0.005
    table = torch.tensor([[float(v) for v in row[1:]] for row in rows[: 6 * count]], dtype=D).view(count, 2, 3, -1)
    to_world = torch.tensor([[0, 0, 1], [0, -1, 0], [1, 0, 0]], dtype=D)
    angles, vectors = to_world @ table[:, 0], to_world @ table[:, 1]
    area, density, modulus = math.pi * radius**2, 1200.0, 70e6
    arm = rod(n_b, length, modulus * area, modulus * math.pi * radius**4 / 4, mass=density * area * length)
    section_wrenches = torch.zeros(count, n_b, 6, dtype=D)
    for column, section in ((1, n_b // 2 - 1), (2, n_b - 1)):
        section_wrenches[:, section] = torch.cat((angles[..., column], vectors[..., column]), dim=-1)
    weight = density * area * vectors[..., 0]
    result = equilibrium(arm, loads=Loads(distributed=weight, section_wrenches=section_wrenches))
    assert bool(result.converged.all())
    tips = torch.stack([section_tips(arm, q) for q in result.q])
    middle = (tips[:, n_b // 2 - 1] - vectors[..., 9]).norm(dim=-1)
    end = (tips[:, -1] - vectors[..., 16]).norm(dim=-1)
    # Constant curvature has neither torsion nor shear: over all 500 shapes that floor is a median of 0.1 mm and at
    # most 1 mm of the rod's 400 mm.
    assert middle.max() < 5e-4 and end.median() < 2e-4 and end.max() < 1e-3
