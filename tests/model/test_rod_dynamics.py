"""The Cosserat rod against its energies by autograd, beam formulas, scipy's boundary value problem and SoRoSim."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_bvp
from torch import Tensor
from torch.autograd.functional import jacobian, jvp

from apcc_torch.errors import ConfigError, ShapeError, ValueRangeError
from apcc_torch.lie import so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.loads import Loads
from apcc_torch.model.rod_dynamics import RodDynamics
from apcc_torch.model.statics import equilibrium
from laws import generator, uniform

D = torch.float64
SCALE = torch.tensor([0.5, 0.5, 0.3, 0.01, 0.01, 0.02], dtype=D)


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=D)


def uneven(n: int = 3, **changes: Any) -> RodDynamics:
    """A hanging rod whose elements differ in everything."""
    rng = generator(3)
    sizes = {"lengths": 0.1, "masses": 0.1, "axial": 50.0, "bending": 0.4, "torsional": 0.3, "shear": 900.0}
    given = [size * uniform((n,), 0.7, 1.3, D, rng) for size in sizes.values()]
    base = torch.diag(numbers(1.0, -1.0, -1.0))
    return RodDynamics(*given, **{"radius": 0.02, "damping_ratio": 0.1, "base_rotation": base, **changes})


def even(n: int, length: float, rigidity: dict[str, float], density: float = 0.0, **changes: Any) -> RodDynamics:
    """A rod of one material all along; density in kg/m."""
    h = length / n
    one = torch.ones(n, dtype=D)
    springs = {f"{name}_stiffness": value / h * one for name, value in rigidity.items()}
    return RodDynamics(h * one, max(density, 1e-12) * h * one, **springs, **{"radius": 0.01, "gravity": 0.0, **changes})


def state(n: int, *rows: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    rng = generator(seed)
    q, qdot = (uniform((*rows, n, 6), -1.0, 1.0, D, rng) * SCALE for _ in range(2))
    return q.flatten(-2), 3.0 * qdot.flatten(-2)


def test_equation_follows_from_its_energies() -> None:
    """Lagrange's equation, by autograd of the kinetic energy and of gravity's potential."""
    rod, payload = uneven(), numbers(0.2)[0]
    q, qdot = state(3)
    M, bias = rod.equation(q, qdot, payload)
    carried = jvp(lambda at: rod.inertia(at, payload), q, qdot)[1] @ qdot
    kinetic = jacobian(lambda at: rod.energy(at, qdot, payload).kinetic, q)
    weight = jacobian(lambda at: rod.energy(at, qdot, payload).gravity, q)
    torch.testing.assert_close(bias, carried - kinetic + weight, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(rod.gravity(q, payload), weight, rtol=1e-10, atol=1e-12)
    assert float(torch.linalg.eigvalsh(M)[0]) > 0.0


def test_kinetic_energy_is_that_of_bodies_seen_to_move() -> None:
    """Bodies placed by the model alone: half of each element's mass at each of its ends, discs of the section."""
    rod, payload, h = uneven(), numbers(0.2)[0], 1e-6
    q, qdot = state(3)
    ends = decouple(rod.lengths.cumsum(0), rod.lengths)
    m, L = (torch.cat((value, numbers(0.0))) for value in (rod.masses, rod.lengths))
    masses, moment = 0.5 * (m[:-1] + m[1:]), (m[1:] * L[1:] - m[:-1] * L[:-1]) / 12.0
    total = masses + payload * numbers(0.0, 0.0, 1.0)

    def centres(at: Tensor) -> tuple[Tensor, Tensor]:
        T = rod.kinematics().pose(at, rod.lengths, *ends)
        return T[:, :3, 3] + (moment / total).unsqueeze(-1) * T[:, :3, 2], T[:, :3, :3]

    (x0, R0), (x1, R1) = centres(q - h * qdot), centres(q + h * qdot)
    v, omega = (x1 - x0) / (2 * h), so3.log(R0.mT @ R1) / (2 * h)  # in the bodies' axes
    disc = masses * 0.02**2 / 4.0
    turning = disc * (omega[:, 0] ** 2 + omega[:, 1] ** 2 + 2.0 * omega[:, 2] ** 2)
    want = 0.5 * (total * v.square().sum(-1) + turning).sum()
    torch.testing.assert_close(rod.energy(q, qdot, payload).kinetic, want, rtol=1e-8, atol=0)


def test_power_is_what_forces_put_in_and_damping_takes() -> None:
    rod, payload = uneven(), numbers(0.2)[0]
    q, qdot = state(3)
    tau = state(3, seed=5)[0]
    qddot = rod(q, qdot, tau, payload)

    def energy(at: Tensor, rate: Tensor) -> Tensor:
        e = rod.energy(at, rate, payload)
        return e.kinetic + e.potential

    power = jvp(energy, (q, qdot), (qdot, qddot))[1]
    torch.testing.assert_close(power, tau @ qdot - (rod.damping_diagonal * qdot) @ qdot, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_a_cantilever_ends_where_the_beam_does(n: int) -> None:
    """Timoshenko's formulas, under a force at the end, and under the beam's own weight, for any number of elements."""
    L, EI, GA, F, w = 0.6, 0.08, 9.0, 1e-6, 1e-6
    level = even(n, L, {"axial": 10.0, "bending": EI, "torsional": 0.06, "shear": GA})
    force = equilibrium(level, loads=Loads(wrench=numbers(0, 0, 0, F, 0, 0)))
    own = equilibrium(level, loads=Loads(distributed=numbers(w, 0, 0)))
    weight = even(
        n, L, {"axial": 10.0, "bending": EI, "torsional": 0.06, "shear": GA}, density=w / 9.81, gravity=9.81,
        base_rotation=numbers(0, 0, 1, 0, 1, 0, -1, 0, 0).view(3, 3),
    )  # fmt: skip
    hung = equilibrium(weight)
    tips = [arm.kinematics().tip(found.q, arm.lengths) for arm, found in ((level, force), (level, own), (weight, hung))]
    under_weight = w * L**4 / (8 * EI) + w * L**2 / (2 * GA)
    assert float(tips[0][0]) == pytest.approx(F * L**3 / (3 * EI) + F * L / GA, rel=1e-6)
    assert float(tips[1][0]) == pytest.approx(under_weight, rel=1e-6)
    assert float(-tips[2][2]) == pytest.approx(under_weight, rel=1e-6)


def cosserat(rigidity: dict[str, float], length: float, weight: Any, wrench: Any) -> Any:
    """Tip of a rod clamped at the origin along z: scipy's solution of the Cosserat equations in space."""
    bend, twist, shear, axial = (rigidity[name] for name in ("bending", "torsional", "shear", "axial"))
    compliance_m, compliance_n = 1.0 / np.array([bend, bend, twist]), 1.0 / np.array([shear, shear, axial])

    def slope(s: Any, y: Any) -> Any:
        p, R, n, m = y[:3], y[3:12].reshape(3, 3, -1), y[12:15], y[15:]
        u = compliance_m[:, None] * np.einsum("jik,jk->ik", R, m)
        v = compliance_n[:, None] * np.einsum("jik,jk->ik", R, n) + np.array([[0.0], [0.0], [1.0]])
        zero = np.zeros_like(u[0])
        hat = np.array([[zero, -u[2], u[1]], [u[2], zero, -u[0]], [-u[1], u[0], zero]])
        p_s = np.einsum("ijk,jk->ik", R, v)
        R_s = np.einsum("ijk,jlk->ilk", R, hat).reshape(9, -1)
        n_s = np.repeat(-np.asarray(weight)[:, None], p.shape[1], axis=1)
        return np.concatenate((p_s, R_s, n_s, -np.cross(p_s, n, axis=0)))

    def ends(a: Any, b: Any) -> Any:
        clamped = np.concatenate((a[:3], a[3:12] - np.eye(3).ravel()))
        return np.concatenate((clamped, b[12:15] - wrench[3:], b[15:] - wrench[:3]))

    s = np.linspace(0.0, length, 40)
    first = np.zeros((18, len(s)))
    first[2], first[3], first[7], first[11] = s, 1.0, 1.0, 1.0
    found = solve_bvp(slope, ends, s, first, tol=1e-6, max_nodes=20_000)
    assert found.success, found.message
    return found.y[:3, -1]


def test_statics_agree_with_the_boundary_value_problem() -> None:
    """A rod that bends, twists, shears and stretches much at once."""
    rigidity, L = {"axial": 30.0, "bending": 0.08, "torsional": 0.05, "shear": 12.0}, 0.5
    weight, wrench = (0.0, -2.0, 0.4), (0.1, -0.05, 0.15, 1.0, 0.6, -0.5)
    want = torch.from_numpy(cosserat(rigidity, L, weight, wrench))
    errors = []
    for n in (5, 10):
        rod = even(n, L, rigidity)
        found = equilibrium(rod, loads=Loads(wrench=numbers(*wrench), distributed=numbers(*weight)))
        assert bool(found.converged)
        errors.append(float((rod.kinematics().tip(found.q, rod.lengths) - want).norm()) / L)
    assert float((want - numbers(0, 0, L)).norm()) > 0.4 * L
    assert errors[1] < 1e-3 and errors[0] / errors[1] > 3.0  # of order two
    # Without torsion and shear it would be another shape.
    stiff = even(10, L, {**rigidity, "torsional": 1e3, "shear": 1e5})
    found = equilibrium(stiff, loads=Loads(wrench=numbers(*wrench), distributed=numbers(*weight)))
    assert float((stiff.kinematics().tip(found.q, stiff.lengths) - want).norm()) / L > 0.02


def test_shapes_of_another_simulator(shared_data: Path) -> None:
    """SoRoSim's TPU rod, at all its stations, within 0.2 % of its length with six elements."""
    path = shared_data / "sorosim_statics" / "TPURod_statics.csv"
    if not path.is_file():
        pytest.skip("no sorosim_statics")
    with path.open() as file:
        lines = list(csv.reader(file))[1:]
    each, n, L, r = 40, 6, 0.4, 0.005
    shapes = [lines[1 + 6 * k : 7 + 6 * k] for k in range(0, 500, each)]
    table = numbers(*[float(v) for shape in shapes for row in shape for v in row[1:]]).view(len(shapes), 2, 3, -1)
    to_world = torch.tensor([[0, 0, 1], [0, -1, 0], [1, 0, 0]], dtype=D)
    angles, vectors = to_world @ table[:, 0], to_world @ table[:, 1]
    area, inertia, E, G = math.pi * r**2, math.pi * r**4 / 4, 70e6, 25e6
    rod = even(n, L, {"axial": E * area, "bending": E * inertia, "torsional": 2 * G * inertia, "shear": G * area})
    wrenches = torch.zeros(len(shapes), n, 6, dtype=D)
    for column, element in ((1, n // 2 - 1), (2, n - 1)):
        wrenches[:, element] = torch.cat((angles[..., column], vectors[..., column]), dim=-1)
    found = equilibrium(rod, loads=Loads(distributed=1200.0 * area * vectors[..., 0], section_wrenches=wrenches))
    assert bool(found.converged.all())
    shares = numbers(*[float(v) for v in lines[0][4:]]).view(2, 7)
    X = (0.5 * L * (shares + numbers(0.0, 1.0).unsqueeze(-1))).flatten()
    stations = rod.kinematics().pose(found.q, rod.lengths, *decouple(X, rod.lengths))[..., :3, 3]
    error = (stations - vectors[..., 3:].mT).norm(dim=-1)
    assert float(error.max()) < 0.002 * L and float(error.mean()) < 0.0005 * L


def test_rows_are_rods_of_their_own() -> None:
    q, qdot = state(3, 4)
    payload, radius = numbers(0.0, 0.1, 0.2, 0.3), numbers(0.01, 0.02, 0.03, 0.04)
    lengths = uneven().lengths * numbers(1.0, 1.1, 0.9, 1.2).unsqueeze(-1)
    wrench = torch.linspace(-1.0, 1.0, 24, dtype=D).view(4, 6)

    def rod(lengths: Tensor, radius: Any) -> RodDynamics:
        like = uneven()
        springs = {name: getattr(like, name) for name in set(like.springs)}
        return RodDynamics(lengths, like.masses, **springs, radius=radius, base_rotation=like.base_rotation)

    together = rod(lengths, radius).equation(q, qdot, payload, wrench)
    for i in range(4):
        alone = rod(lengths[i], float(radius[i])).equation(q[i], qdot[i], payload[i], wrench[i])
        torch.testing.assert_close((together.inertia[i], together.bias[i]), tuple(alone), rtol=1e-10, atol=1e-12)
    single = rod(lengths, radius).float().equation(q.float(), qdot.float(), payload.float(), wrench.float())
    torch.testing.assert_close(single.bias.double(), together.bias, rtol=1e-3, atol=1e-4)


def test_bad_rods_are_refused() -> None:
    with pytest.raises(ConfigError, match="base_rotation"):
        uneven(base_rotation=torch.eye(3, dtype=D).expand(2, 3, 3))
    with pytest.raises(ValueRangeError, match="radius"):
        uneven(radius=0.0)
    with pytest.raises(ShapeError, match="qdot"):
        uneven().equation(state(3)[0], state(2)[1])
