"""SO(3) against torch.matrix_exp, automatic differentiation, scipy's rotations and fifty-digit arithmetic."""

from __future__ import annotations

from collections.abc import Callable
from math import pi

import mpmath
import pytest
import torch
from hypothesis import given
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.func import hessian, jacfwd, jacrev, vmap

from apcc_torch.errors import ShapeError
from apcc_torch.lie import quaternion_rotation, rotation_quaternion, so3
from laws import (
    FLOATS,
    check_bad_row,
    check_batching,
    check_gradients,
    floats,
    generator,
    normal,
    rotation_vectors,
    rotations,
    seeds,
    uniform,
    unit_vectors,
)

ANGLES = [0.0, 1e-12, 1e-9, 1e-8, 1e-6, 1e-4, 1e-3, 0.01, 0.04, 0.0446, 0.0448, 0.05, 0.1, 0.5, 1.0, 1.57, 2.0]
ANGLES += [2.1, 2.5, 3.0, 3.1, pi - 1e-3, pi - 1e-6]
HALF_TURNS = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0.6, 0, -0.8], [-0.6, 0.8, 0], [1.0, 2.0, -2.0], [-2, 3, 1]]


def grid(dtype: torch.dtype = torch.float64) -> Tensor:
    """Seven directions at every angle, (angles, 7, 3)."""
    angle = torch.tensor(ANGLES, dtype=torch.float64)[:, None, None]
    return (angle * unit_vectors((7,), torch.float64, generator(3))).to(dtype)


def half_turns(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Rotations by exactly pi and their axes."""
    axis = torch.nn.functional.normalize(torch.tensor(HALF_TURNS, dtype=torch.float64), dim=-1)
    turn = 2.0 * axis.unsqueeze(-1) * axis.unsqueeze(-2) - torch.eye(3, dtype=torch.float64)
    return turn.to(dtype), axis.to(dtype)


def test_hat_is_the_cross_product_and_vee_its_inverse() -> None:
    a, b = normal((5, 3), torch.float64, generator(0)), normal((5, 3), torch.float64, generator(1))
    torch.testing.assert_close((so3.hat(a) @ b.unsqueeze(-1)).squeeze(-1), torch.linalg.cross(a, b))
    assert torch.equal(so3.vee(so3.hat(a)), a)


@given(seed=seeds)
def test_exp_matches_matrix_exp(seed: int) -> None:
    w = rotation_vectors((20,), torch.float64, generator(seed), max_angle=9.0)
    torch.testing.assert_close(so3.exp(w), torch.matrix_exp(so3.hat(w)), rtol=0, atol=2e-14)


@pytest.mark.parametrize("dtype", FLOATS)
def test_exp_at_every_angle(dtype: torch.dtype) -> None:
    w = grid(dtype)
    want = torch.from_numpy(Rotation.from_rotvec(w.double().reshape(-1, 3).numpy()).as_matrix()).reshape(*w.shape, 3)
    torch.testing.assert_close(so3.exp(w).double(), want, rtol=0, atol=8 * torch.finfo(dtype).eps)
    assert torch.equal(so3.exp(torch.zeros(3, dtype=dtype)), torch.eye(3, dtype=dtype))


@pytest.mark.parametrize("dtype", FLOATS)
def test_log_undoes_exp_at_every_angle(dtype: torch.dtype) -> None:
    w = grid()
    log = so3.log(so3.exp(w).to(dtype)).double()
    # Relative to the angle where it is small: entries of the matrix near the identity keep the small angle in full.
    size = w.norm(dim=-1, keepdim=True).clamp(1e-30, 1.0)
    assert ((log - w).abs() / size).max() < 16 * torch.finfo(dtype).eps
    assert torch.equal(so3.log(torch.eye(3, dtype=dtype)), torch.zeros(3, dtype=dtype))


@given(seed=seeds, dtype=floats)
def test_log_matches_scipy(seed: int, dtype: torch.dtype) -> None:
    rotation = rotations((20,), torch.float64, generator(seed))
    want = torch.from_numpy(Rotation.from_matrix(rotation.numpy()).as_rotvec())
    have = so3.log(rotation.to(dtype))
    assert have.dtype == dtype
    eps = torch.finfo(dtype).eps
    # At half a turn either sign will do; elsewhere the sign is scipy's.
    same = (have.double() - want).norm(dim=-1)
    other = (have.double() + want).norm(dim=-1)
    assert (torch.where(want.norm(dim=-1) > pi - 8 * eps, torch.minimum(same, other), same) < 32 * eps).all()
    torch.testing.assert_close(so3.exp(have).double(), rotation, rtol=0, atol=32 * eps)


@pytest.mark.parametrize("dtype", FLOATS)
def test_log_of_half_a_turn(dtype: torch.dtype) -> None:
    rotation, axis = half_turns(dtype)
    log = so3.log(rotation)
    largest = log.abs().argmax(-1, keepdim=True)
    assert (log.gather(-1, largest) > 0).all()
    axis = axis * axis.gather(-1, largest).sign()
    torch.testing.assert_close(log, pi * axis, rtol=0, atol=16 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_of_exp_has_the_derivatives_of_the_identity(angle: float) -> None:
    def round_trip(w: Tensor) -> Tensor:
        return so3.log(so3.exp(w))

    w = angle * unit_vectors((3,), torch.float64, generator(5))
    eye = torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    for jacobian in (jacfwd, jacrev):
        torch.testing.assert_close(vmap(jacobian(round_trip))(w), eye, rtol=0, atol=1e-12)
    second = vmap(hessian(round_trip))(w)
    torch.testing.assert_close(second, torch.zeros_like(second), rtol=0, atol=1e-11)


@pytest.mark.parametrize("dtype", FLOATS)
def test_derivatives_of_log_are_finite_at_identity_and_half_a_turn(dtype: torch.dtype) -> None:
    rotation = torch.cat((half_turns(dtype)[0], torch.eye(3, dtype=dtype)[None]))
    assert vmap(jacrev(so3.log))(rotation).isfinite().all()
    assert vmap(hessian(so3.log))(rotation).isfinite().all()


@pytest.mark.parametrize("op", [so3.exp, so3.left_jacobian, so3.left_jacobian_inverse])
def test_every_mode_of_differentiation_keeps_single_precision(op: Callable[[Tensor], Tensor]) -> None:
    w = rotation_vectors((), torch.float32, generator(0))
    for differentiate in (jacfwd, jacrev, hessian):
        assert differentiate(op)(w).dtype == torch.float32
        assert differentiate(lambda x: so3.log(op(x)))(w).dtype == torch.float32


def test_gradients_match_finite_differences() -> None:
    rng = generator(2)
    tiny = torch.cat((torch.zeros(1, 3), 1e-3 * normal((1, 3), torch.float32, rng)))
    check_gradients(so3.exp, torch.cat((tiny, rotation_vectors((2,), torch.float32, rng))))
    check_gradients(so3.left_jacobian_inverse, torch.cat((tiny, rotation_vectors((2,), torch.float32, rng))))
    check_gradients(so3.log, torch.cat((torch.eye(3, dtype=torch.float64)[None], rotations((2,), torch.float64, rng))))
    check_gradients(lambda r: so3.half_log(r)[1], rotations((3,), torch.float64, rng))
    near_half = so3.exp((pi - 0.01) * unit_vectors((3,), torch.float64, rng))
    check_gradients(so3.log, near_half)


def test_jacobians_turn_rates_into_angular_velocities() -> None:
    for w in (*rotation_vectors((4,), torch.float64, generator(1), max_angle=6.0), torch.zeros(3, dtype=torch.float64)):
        rotation, slope = so3.exp(w), jacfwd(so3.exp)(w).movedim(-1, 0)
        fixed, body = slope @ rotation.mT, rotation.mT @ slope
        torch.testing.assert_close(so3.left_jacobian(w), so3.vee(fixed).mT, rtol=0, atol=1e-13)
        torch.testing.assert_close(so3.right_jacobian(w), so3.vee(body).mT, rtol=0, atol=1e-13)
        torch.testing.assert_close(fixed, -fixed.mT, rtol=0, atol=1e-13)


@given(seed=seeds)
def test_jacobian_identities(seed: int) -> None:
    w = rotation_vectors((10,), torch.float64, generator(seed), max_angle=6.2)
    left, right = so3.left_jacobian(w), so3.right_jacobian(w)
    eye = torch.eye(3, dtype=torch.float64).expand(10, 3, 3)
    torch.testing.assert_close(left, right.mT, rtol=0, atol=1e-15)
    torch.testing.assert_close(left, so3.exp(w) @ right, rtol=0, atol=1e-13)
    torch.testing.assert_close(so3.left_jacobian_inverse(w) @ left, eye, rtol=0, atol=1e-12)
    torch.testing.assert_close(so3.right_jacobian_inverse(w) @ right, eye, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", FLOATS)
def test_inverse_coefficient_matches_fifty_digits(dtype: torch.dtype) -> None:
    x = torch.tensor([1e-30, 1e-12, 1e-6, 1e-2, 1.0, 3.99, 4.01, 9.8, 15.9, 16.1, 30.0, 39.0, 39.4], dtype=dtype)
    want = []
    with mpmath.workdps(50):
        for value in x.tolist():
            half = mpmath.sqrt(mpmath.mpf(value)) / 2
            want.append(float((1 - half * mpmath.cot(half)) / mpmath.mpf(value)))
    have = so3.inverse_coefficient(x).double()
    error = (have / torch.tensor(want, dtype=torch.float64) - 1.0).abs()
    # Towards its pole at 4 pi^2 a relative change of x grows by x / (4 pi^2 - x).
    assert (error < 16 * torch.finfo(dtype).eps * (1.0 + x / (4 * pi**2 - x))).all()


def test_inverse_coefficient_at_zero() -> None:
    x = torch.zeros((), dtype=torch.float64, requires_grad=True)
    e = so3.inverse_coefficient(x)
    (first,) = torch.autograd.grad(e, x, create_graph=True)
    (second,) = torch.autograd.grad(first, x)
    # Bernoulli numbers: 1/12 + x/720 + x^2/30240.
    assert [e.item(), first.item(), second.item()] == pytest.approx([1 / 12, 1 / 720, 1 / 15120], rel=1e-13)


@pytest.mark.parametrize("dtype", FLOATS)
def test_half_log_carries_the_inverse_coefficient(dtype: torch.dtype) -> None:
    w = grid()
    have = so3.half_log(so3.exp(w).to(dtype))[1].double()
    x = so3.squared_angle(w)
    # It multiplies the square of the angle, so that is the precision it needs.
    error = (have - 4.0 * so3.inverse_coefficient(x)).abs() * x.clamp_min(1e-2)
    assert error.max() < 32 * torch.finfo(dtype).eps


@pytest.mark.parametrize(
    "op",
    [
        so3.hat,
        so3.exp,
        so3.squared_angle,
        so3.left_jacobian,
        so3.right_jacobian,
        so3.left_jacobian_inverse,
        so3.right_jacobian_inverse,
    ],
)
def test_laws_of_vector_operations(op: Callable[[Tensor], Tensor]) -> None:
    check_batching(op, lambda shape, dtype, rng: (rotation_vectors(shape, dtype, rng),))
    check_bad_row(op, (rotation_vectors((4,), torch.float32, generator()),))


@pytest.mark.parametrize("op", [so3.vee, so3.log, so3.half_log])
def test_laws_of_matrix_operations(op: Callable[[Tensor], Tensor]) -> None:
    check_batching(op, lambda shape, dtype, rng: (rotations(shape, dtype, rng),))
    check_bad_row(op, (rotations((4,), torch.float32, generator()),))


def test_laws_of_scalar_operations() -> None:
    check_batching(so3.inverse_coefficient, lambda shape, dtype, rng: (uniform(shape, 0.0, 9.0, dtype, rng),))


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ShapeError, match=r"w must have shape \(\.\.\., 3\), got \(4, 2\)"):
        so3.exp(torch.zeros(4, 2))
    with pytest.raises(ShapeError, match=r"rotation must have shape \(\.\.\., 3, 3\), got \(4, 4\)"):
        so3.log(torch.eye(4))


def test_a_rotation_has_the_quaternion_that_makes_it() -> None:
    turn = torch.cat((normal((200, 3), torch.float64, generator(3)), torch.zeros(1, 3, dtype=torch.float64)))
    half = so3.exp(torch.eye(3, dtype=torch.float64) * torch.pi)
    R = torch.cat((so3.exp(2.0 * turn), half))
    q = rotation_quaternion(R)
    torch.testing.assert_close(quaternion_rotation(q), R, rtol=0, atol=1e-14)
    torch.testing.assert_close(q.norm(dim=-1), torch.ones_like(q[:, 0]), rtol=0, atol=1e-14)
    assert (q[:, 3] >= 0.0).all()
