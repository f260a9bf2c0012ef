"""Y_d theta against `SoftArmDynamics` of those parameters, against autograd, and its Slotine-Li form."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.dynamics_regressor import PARAMETERS, DynamicsRegressor
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from arms import HANGING_BASE, PI, configurations, rest_lengths
from laws import check_bad_row, check_batching, check_gradients, generator, rotations, seeds, uniform

D = torch.float64
ROUTING = rack_routing(PI.cumsum(0))
RATIO = 0.07
THETA = torch.tensor([0.06, 8.0, 150.0, 0.35, 1.3], dtype=D)


def regressor(base: Tensor = HANGING_BASE, **settings: float) -> DynamicsRegressor:
    return DynamicsRegressor(ROUTING, base, RATIO, **settings)


def arm(lengths: Tensor, theta: Tensor, base: Tensor = HANGING_BASE) -> SoftArmDynamics:
    """The arm of parameters theta without its payload and its tendons' friction."""
    axial, bending = scaled_stiffness(lengths, 1.0, theta[1], theta[0])
    return SoftArmDynamics(lengths, theta[4] * lengths / lengths.sum(), axial, bending, RATIO, base_rotation=base)


def motion(seed: int, shape: tuple[int, ...] = (), dtype: torch.dtype = D) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """q and three of its rates."""
    rng = generator(seed)
    q, qdot, v, a = (configurations(shape, 3, dtype, rng, elongation=0.02) for _ in range(4))
    return q, 2.0 * qdot, 2.0 * v, 5.0 * a


def friction(v: Tensor, lengths: Tensor) -> Tensor:
    B = ROUTING.matrix(lengths)
    return (B @ (B.mT @ v.unsqueeze(-1))).squeeze(-1)


@settings(max_examples=10)
@given(seed=seeds)
def test_it_is_the_equation_of_motion(seed: int) -> None:
    rng = generator(seed)
    lengths, base = rest_lengths((), 3, D, rng), rotations((), D, rng)
    theta = uniform((5,), 0.2, 2.0, D, rng) * THETA
    q, qdot, _, qddot = motion(seed)
    tau = regressor(base)(q, qdot, qdot, qddot, lengths) @ theta
    # The arm itself, driven by that force less what its tendons' friction takes, accelerates as was asked.
    have = arm(lengths, theta, base)(q, qdot, tau - theta[2] * friction(qdot, lengths), theta[3])
    torch.testing.assert_close(have, qddot, rtol=1e-9, atol=1e-9)


@settings(max_examples=10)
@given(seed=seeds)
def test_slotine_li_form(seed: int) -> None:
    q, qdot, v, a = motion(seed)
    held = motion(seed + 1)[0]
    one = arm(PI, THETA)
    M, C = one.inertia(q, THETA[3]), one.coriolis(q, qdot, THETA[3])
    want = M @ a + C @ v + one.gravity(q, THETA[3]) + one.stiffness_diagonal * held + one.damping_diagonal * v
    have = regressor()(q, qdot, v, a, PI, held) @ THETA
    torch.testing.assert_close(have, want + THETA[2] * friction(v, PI), rtol=1e-10, atol=1e-11)


def test_columns_are_derivatives_of_the_torque() -> None:
    q, qdot, _, qddot = motion(3)

    def torque(theta: Tensor) -> Tensor:
        one = arm(PI, theta)
        M, bias = one.equation(q, qdot, theta[3])
        elastic = one.stiffness_diagonal * q + one.damping_diagonal * qdot
        return M @ qddot + bias + elastic + theta[2] * friction(qdot, PI)

    slopes = torch.autograd.functional.jacobian(torque, THETA)
    torch.testing.assert_close(regressor()(q, qdot, qdot, qddot, PI), slopes, rtol=1e-10, atol=1e-11)
    assert slopes.shape == (9, len(PARAMETERS))


@pytest.mark.parametrize("column", [3, 4])
def test_mdot_less_twice_c_is_skew(column: int) -> None:
    """x^T (Mdot - 2 C) x = 0 along the motion, for the payload and for the arm's mass, with M and C read off Y_d."""
    q, qdot, x, _ = motion(7)
    Y, zero, eye = regressor(), torch.zeros(9, dtype=D), torch.eye(9, dtype=D)

    def inertia(q: Tensor) -> Tensor:
        at_rest = Y(q, zero, zero, eye, PI) - Y(q, zero, zero, zero, PI)
        return at_rest[..., column].mT

    _, Mdot = torch.func.jvp(inertia, (q,), (qdot,))
    quiet = zero  # elasticity off, so that its column holds no part of v
    Cx = (Y(q, qdot, x, zero, PI, quiet) - Y(q, qdot, zero, zero, PI, quiet))[..., column]
    assert float((x @ Mdot @ x).abs()) > 1e-4, "the inertia must change for this to say something"
    torch.testing.assert_close(x @ Mdot @ x, 2.0 * x @ Cx, rtol=1e-9, atol=1e-12)


def test_one_arm_of_each_row_and_batches() -> None:
    Y = regressor()

    def make(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
        q, qdot, v, a = (configurations(shape, 3, dtype, rng) for _ in range(4))
        return q, qdot, v, a, rest_lengths(shape, 3, dtype, rng)

    check_batching(Y, make, dtypes=(D,), shared=(4,), scale=10.0)
    inputs = make((4,), D, generator(0))
    check_bad_row(Y, inputs)
    single = Y.to(torch.float32)(*(value.float() for value in inputs))
    assert single.dtype == torch.float32
    Y.to(D)
    torch.testing.assert_close(single.double(), regressor()(*inputs), rtol=1e-3, atol=1e-3)


def test_gradients() -> None:
    q, qdot, v, a = motion(5)
    Y = regressor()
    check_gradients(lambda *given: Y(*given, PI), q, qdot, v, a, second=False)
    check_gradients(lambda L0: Y(q, qdot, v, a, L0), 1.03 * PI, second=False)
    straight = torch.zeros(9, dtype=D)
    check_gradients(lambda *given: Y(*given, PI), straight, qdot, v, a, second=False, atol=1e-4)


def test_bad_input_is_named() -> None:
    q, qdot, v, a = motion(0)
    Y = regressor()
    with pytest.raises(ShapeError, match=r"v must have shape \(\.\.\., 9\)"):
        Y(q, qdot, v[:6], a, PI)
    with pytest.raises(DtypeError, match=r"a is torch\.float32"):
        Y(q, qdot, v, a.float(), PI)
    with pytest.raises(ShapeError, match="leading dimensions"):
        Y(q.expand(2, 9), qdot.expand(3, 9), v, a, PI)
    with pytest.raises(ShapeError, match="base_rotation"):
        regressor(torch.eye(4, dtype=D))
    for settings_, name in (({"n_quadrature": 1}, "n_quadrature"), ({"gravity": float("nan")}, "gravity")):
        with pytest.raises(ValueRangeError, match=name):
            regressor(**settings_)
    with pytest.raises(ValueRangeError, match="damping_ratio"):
        DynamicsRegressor(ROUTING, HANGING_BASE, -0.1)


def test_a_straight_arm_at_rest_carries_the_payload_along_itself() -> None:
    zero = torch.zeros(9, dtype=D)
    payload = regressor()(zero, zero, zero, zero, PI)[..., 3]
    want = torch.tensor([0.0, 0.0, -9.81] * 3, dtype=D)
    torch.testing.assert_close(payload, want, rtol=1e-12, atol=1e-12)
