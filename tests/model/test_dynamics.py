"""The equations of motion against Lagrange's: energies from point positions alone, differentiated automatically."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor
from torch.func import grad, jacfwd, jacrev, jvp

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.model.arc import arc_pose
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.stiffness import scaled_stiffness
from laws import check_bad_row, check_batching, check_gradients, generator, normal, rotations, seeds, uniform

D = torch.float64
HANGING = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=D))
PLANT = torch.tensor([0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12], dtype=D)


def paper_arm(rule: str = "series", dtype: torch.dtype = D, n_quadrature: int = 4, **other: object) -> SoftArmDynamics:
    axial, bending = scaled_stiffness(PLANT, rule=rule)
    options = {"damping_ratio": 0.1, "base_rotation": HANGING} | other
    arm = SoftArmDynamics(PLANT, PLANT / 0.6, axial, bending, n_quadrature=n_quadrature, **options)  # type: ignore[arg-type]
    return arm.to(dtype)


def small_arm(seed: int = 0, shape: tuple[int, ...] = (), dtype: torch.dtype = D, n_b: int = 3) -> SoftArmDynamics:
    """An arm of random parameters, tilted; a batch of different arms with `shape`."""
    rng = generator(seed)
    size = (*shape, n_b)
    return SoftArmDynamics(
        uniform(size, 0.08, 0.2, D, rng),
        uniform(size, 0.1, 0.4, D, rng),
        uniform(size, 60.0, 150.0, D, rng),
        uniform(size, 0.5, 1.0, D, rng),
        damping_ratio=0.05,
        base_rotation=rotations(shape, D, rng),
    ).to(dtype)


def states(
    seed: int, n_b: int = 3, shape: tuple[int, ...] = (), dtype: torch.dtype = D, bend: float = 0.5
) -> tuple[Tensor, Tensor, Tensor]:
    """q, qdot and tau of ordinary size."""
    rng = generator(seed)
    scale = torch.tensor([bend, bend, 0.02], dtype=D)
    draw = [(normal((*shape, n_b, 3), D, rng) * scale).flatten(-2).to(dtype) for _ in range(3)]
    return draw[0], 4.0 * draw[1], draw[2]


def positions(arm: SoftArmDynamics, q: Tensor, n: int = 4) -> Tensor:
    """World positions (n_b n + 1, 3) of Gauss-Legendre points and of the tip, section by section along the arm."""
    nodes, _ = gauss(n)
    rotation, base, found = arm.base_rotation, torch.zeros(3, dtype=q.dtype), []
    for i, length in enumerate(arm.lengths):
        x, y, stretch = q[3 * i : 3 * i + 3]
        for s in nodes:
            found.append(base + s * (length + stretch) * rotation @ arc_pose(s * x, s * y)[1])
        turn, chord = arc_pose(x, y)
        base = base + (length + stretch) * rotation @ chord
        rotation = rotation @ turn
    return torch.stack([*found, base])


def gauss(n: int) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre on (0, 1) from numpy."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    return torch.from_numpy((nodes + 1) / 2), torch.from_numpy(weights / 2)


def point_masses(arm: SoftArmDynamics, payload: float, n: int = 4) -> Tensor:
    return torch.cat(((arm.masses[:, None] * gauss(n)[1]).flatten(), torch.tensor([payload], dtype=D)))


def kinetic(arm: SoftArmDynamics, q: Tensor, qdot: Tensor, payload: float) -> Tensor:
    _, velocity = jvp(lambda v: positions(arm, v), (q,), (qdot,))
    return 0.5 * (point_masses(arm, payload)[:, None] * velocity**2).sum()


def height_energy(arm: SoftArmDynamics, q: Tensor, payload: float) -> Tensor:
    return 9.81 * (point_masses(arm, payload) * positions(arm, q)[:, 2]).sum()


@settings(max_examples=8)
@given(seed=seeds)
def test_inertia_is_the_hessian_of_kinetic_energy(seed: int) -> None:
    arm = small_arm(seed)
    q, qdot, _ = states(seed)
    inertia = arm.inertia(q, 0.3)
    # Kinetic energy is quadratic in the points' velocities, which are their Jacobian times qdot.
    columns = jacrev(lambda v: positions(arm, v))(q)
    want = torch.einsum("k,kci,kcj->ij", point_masses(arm, 0.3), columns, columns)
    torch.testing.assert_close(inertia, want, rtol=1e-11, atol=1e-14)
    assert torch.equal(inertia, inertia.mT)
    assert torch.linalg.eigvalsh(inertia).min() > 0
    torch.testing.assert_close(arm.equation(q, qdot, 0.3).inertia, inertia, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("seed", [0, 1])
def test_coriolis_is_the_christoffel_matrix(seed: int) -> None:
    arm = small_arm(seed)
    q, qdot, _ = states(seed)
    slope = jacfwd(lambda v: arm.inertia(v, 0.3))(q)  # dM_ij / dq_k
    # Eq. (37)
    symbols = 0.5 * (slope + slope.transpose(1, 2) - slope.permute(2, 0, 1))
    want = symbols @ qdot
    torch.testing.assert_close(arm.coriolis(q, qdot, 0.3), want, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(arm.bias(q, qdot, 0.3), want @ qdot, rtol=1e-10, atol=1e-12)
    # Mdot - 2 C is skew.
    skew = slope @ qdot - 2.0 * arm.coriolis(q, qdot, 0.3)
    torch.testing.assert_close(skew, -skew.mT, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", [2, 3])
def test_bias_from_lagranges_equations(seed: int) -> None:
    arm = small_arm(seed)
    q, qdot, _ = states(seed)
    # d/dt dT/dqdot - dT/dq at qddot = 0.
    momentum_rate = jvp(lambda v: grad(lambda w: kinetic(arm, v, w, 0.2))(qdot), (q,), (qdot,))[1]
    want = momentum_rate - grad(lambda v: kinetic(arm, v, qdot, 0.2))(q)
    torch.testing.assert_close(arm.bias(q, qdot, 0.2), want, rtol=1e-10, atol=1e-12)


@settings(max_examples=8)
@given(seed=seeds)
def test_gravity_and_stiffness_are_gradients_of_potential_energy(seed: int) -> None:
    arm = small_arm(seed)
    q, qdot, _ = states(seed)
    energy = arm.energy(q, qdot, 0.4)
    torch.testing.assert_close(energy.gravity, height_energy(arm, q, 0.4))
    torch.testing.assert_close(energy.kinetic, kinetic(arm, q, qdot, 0.4))
    torch.testing.assert_close(energy.potential, energy.gravity + energy.elastic)
    want = grad(lambda v: height_energy(arm, v, 0.4))(q)
    torch.testing.assert_close(arm.gravity(q, 0.4), want, rtol=1e-11, atol=1e-13)
    torch.testing.assert_close(arm.stiffness @ q, grad(lambda v: arm.energy(v, qdot).elastic)(q))
    equation = arm.equation(q, qdot, 0.4)
    torch.testing.assert_close(equation.bias, arm.bias(q, qdot, 0.4) + arm.gravity(q, 0.4), rtol=1e-11, atol=1e-12)


@settings(max_examples=8)
@given(seed=seeds)
def test_power_balance(seed: int) -> None:
    arm = small_arm(seed)
    q, qdot, tau = states(seed)
    wrench = normal((6,), D, generator(seed))
    qddot = arm(q, qdot, tau, 0.3, wrench=wrench)
    energy_rate = jvp(
        lambda a, b: sum(arm.energy(a, b, 0.3)[:2]), (q, qdot), (qdot, qddot)
    )[1]  # fmt: skip
    tip = jvp(lambda v: positions(arm, v)[-1], (q,), (qdot,))[1]
    power = tau @ qdot - qdot @ arm.damping @ qdot + wrench[3:] @ tip + wrench[:3] @ tip_spin(arm, q, qdot)
    torch.testing.assert_close(energy_rate, power, rtol=1e-9, atol=1e-10)


def tip_spin(arm: SoftArmDynamics, q: Tensor, qdot: Tensor) -> Tensor:
    """World angular velocity of the tip frame, from the rate of its rotation."""

    def rotation(v: Tensor) -> Tensor:
        frame = arm.base_rotation
        for x, y, _ in v.unflatten(-1, (-1, 3)):
            frame = frame @ arc_pose(x, y)[0]
        return frame

    frame, rate = jvp(rotation, (q,), (qdot,))
    hat = rate @ frame.mT
    return torch.stack((hat[2, 1], hat[0, 2], hat[1, 0]))


@settings(max_examples=8)
@given(seed=seeds)
def test_external_loads_do_virtual_work(seed: int) -> None:
    arm = small_arm(seed)
    q, _, _ = states(seed)
    rng = generator(seed)
    wrench, load = normal((6,), D, rng), normal((3,), D, rng)
    points = jacrev(lambda v: positions(arm, v))(q)
    spin = torch.stack([tip_spin(arm, q, e) for e in torch.eye(9, dtype=D)], dim=-1)
    share = (arm.lengths[:, None] * gauss(4)[1]).flatten()
    work = wrench[3:] @ points[-1] + wrench[:3] @ spin + torch.einsum("k,c,kcn->n", share, load, points[:-1])
    torch.testing.assert_close(arm.gravity(q) - arm.static_load(q, None, wrench, load), work, rtol=1e-10, atol=1e-12)


def test_quadrature_has_converged() -> None:
    q, qdot, tau = states(1, 6, (20,), bend=0.4)
    fine, usual = paper_arm(n_quadrature=10), paper_arm()
    torch.testing.assert_close(usual.inertia(q), fine.inertia(q), rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(usual.bias(q, qdot), fine.bias(q, qdot), rtol=1e-6, atol=1e-7)
    want = fine(q, qdot, tau)
    assert (usual(q, qdot, tau) - want).norm() < 1e-5 * want.norm()


def test_straight_rod_of_uniform_mass() -> None:
    arm = SoftArmDynamics(*(torch.tensor([v], dtype=D) for v in (0.3, 0.6, 100.0, 1.0)))
    # A point at s L moves by s^2 L / 2 per bend and by s per stretch: m L^2 / 20 and m / 3.
    want = torch.diag(torch.tensor([0.6 * 0.09 / 20, 0.6 * 0.09 / 20, 0.6 / 3], dtype=D))
    torch.testing.assert_close(arm.inertia(torch.zeros(3, dtype=D)), want, rtol=1e-13, atol=1e-15)
    payload = arm.inertia(torch.zeros(3, dtype=D), torch.tensor(0.5, dtype=D)) - want
    torch.testing.assert_close(payload, torch.diag(torch.tensor([0.5 * 0.09 / 4, 0.5 * 0.09 / 4, 0.5], dtype=D)))


def test_stiffness_rules() -> None:
    lengths = torch.tensor([0.05, 0.1, 0.2], dtype=D)
    axial, bending = scaled_stiffness(lengths)
    torch.testing.assert_close(axial, torch.tensor([200.0, 100.0, 50.0], dtype=D))
    torch.testing.assert_close(bending, torch.tensor([1.556, 0.778, 0.389], dtype=D))
    axial, _ = scaled_stiffness(lengths, rule="proportional")
    torch.testing.assert_close(axial, torch.tensor([50.0, 100.0, 200.0], dtype=D))
    with pytest.raises(ValueRangeError, match="rule"):
        scaled_stiffness(lengths, rule="parallel")
    arm = paper_arm()
    torch.testing.assert_close(arm.damping, 0.1 * arm.stiffness)


def test_batching() -> None:
    arms = {dtype: small_arm(0, dtype=dtype) for dtype in (torch.float32, D)}

    def make(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
        payload = uniform(shape, 0.0, 0.5, dtype, rng)
        return *states(3, 3, shape, dtype), payload, normal((*shape, 6), dtype, rng), normal((*shape, 3), dtype, rng)

    def parts(q: Tensor, qdot: Tensor, _: Tensor, payload: Tensor, *loads: Tensor) -> tuple[Tensor, ...]:
        arm = arms[q.dtype]
        equation = arm.equation(q, qdot, payload, *loads)
        return *equation, arm.gravity(q, payload), arm.coriolis(q, qdot, payload), *arm.energy(q, qdot, payload)

    check_batching(parts, make, scale=10.0, shared=(0, 4, 5))

    def forward(*inputs: Tensor) -> Tensor:
        return arms[inputs[0].dtype](*inputs)

    check_batching(forward, make, dtypes=(D,), scale=1e3)
    # In single precision the solve is as good as M's condition allows.
    single = forward(*make((20,), torch.float32, generator(0)))
    double = forward(*make((20,), D, generator(0)))
    assert (single.double() - double).norm() < 2e-3 * double.norm()


def test_a_batch_of_different_arms() -> None:
    arms = small_arm(5, (4,))
    q, qdot, tau = states(6, 3, (4,))
    together = arms(q, qdot, tau, 0.2)
    spread = arms(q[0], qdot[0], tau[0], 0.2)
    assert spread.shape == (4, 9)
    for i in range(4):
        alone = SoftArmDynamics(
            arms.lengths[i], arms.masses[i], arms.stiffness_diagonal[i, 2::3], arms.stiffness_diagonal[i, ::3],
            damping=arms.damping_diagonal[i], base_rotation=arms.base_rotation[i],
        )  # fmt: skip
        torch.testing.assert_close(alone(q[i], qdot[i], tau[i], 0.2), together[i], rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(alone(q[0], qdot[0], tau[0], 0.2), spread[i], rtol=1e-9, atol=1e-10)


def test_bad_row_stays_in_its_row() -> None:
    arm = small_arm()

    def op(q: Tensor, qdot: Tensor, tau: Tensor, payload: Tensor) -> Tensor:
        return arm(q, qdot, tau, payload)

    inputs = (*states(3, 3, (5,)), torch.full((5,), 0.1, dtype=D))
    check_bad_row(op, inputs)
    # A negative payload makes M indefinite: NaN in that row, no exception.
    payload = inputs[3].clone()
    payload[2] = -50.0
    result = op(*inputs[:3], payload)
    assert bool(result[2].isnan().all()) and bool(result[[0, 1, 3, 4]].isfinite().all())


def test_gradients() -> None:
    arm = small_arm(1, n_b=2)
    q, qdot, tau = states(4, 2)
    payload, wrench = torch.tensor(0.2, dtype=D), normal((6,), D, generator(0))
    check_gradients(lambda *a: arm(a[0], a[1], a[2], a[3], a[4]), q, qdot, tau, payload, wrench, second=False)
    # At the straight pose too, and forward mode.
    straight = torch.zeros(6, dtype=D)
    check_gradients(lambda a, b: arm(a, b, tau), straight, straight, second=False, atol=1e-3)
    forward = jacfwd(lambda a: arm(a, qdot, tau))(q)
    torch.testing.assert_close(forward, jacrev(lambda a: arm(a, qdot, tau))(q), rtol=1e-8, atol=1e-8)


def test_gradients_by_parameters() -> None:
    q, qdot, tau = states(4, 2)
    lengths, masses = torch.tensor([0.1, 0.15], dtype=D), torch.tensor([0.2, 0.3], dtype=D)
    axial, bending = torch.tensor([90.0, 80.0], dtype=D), torch.tensor([0.8, 0.6], dtype=D)

    def op(*parameters: Tensor) -> Tensor:
        return SoftArmDynamics(*parameters, damping_ratio=0.1)(q, qdot, tau)

    check_gradients(op, lengths, masses, axial, bending, second=False)


def test_bad_input_is_named() -> None:
    arm = small_arm()
    q, qdot, tau = states(0)
    with pytest.raises(ShapeError, match=r"qdot must have shape \(\.\.\., 9\)"):
        arm(q, qdot[:4], tau)
    with pytest.raises(ShapeError, match="leading dimensions"):
        arm(q.expand(3, 9), qdot.expand(2, 9), tau)
    with pytest.raises(DtypeError, match=r"q is torch\.float32"):
        arm.bias(q.float(), qdot)
    one = torch.ones(3, dtype=D)
    with pytest.raises(ValueRangeError, match="masses"):
        SoftArmDynamics(one, -one, one, one)
    with pytest.raises(ValueRangeError, match="damping"):
        SoftArmDynamics(one, one, one, one, damping=-torch.ones(9, dtype=D))
    with pytest.raises(ShapeError, match="axial_stiffness"):
        SoftArmDynamics(one, one, one[:2], one)
    with pytest.raises(ValueRangeError, match="n_quadrature"):
        SoftArmDynamics(one, one, one, one, n_quadrature=1)
