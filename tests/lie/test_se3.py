"""SE(3) against torch.matrix_exp, power series of ad, and automatic differentiation."""

from __future__ import annotations

from collections.abc import Callable
from math import pi

import pytest
import torch
from hypothesis import given
from torch import Tensor
from torch.func import hessian, jacfwd, jacrev, vmap

from apcc_torch.errors import ShapeError
from apcc_torch.lie import se3, so3
from laws import (
    FLOATS,
    check_bad_row,
    check_batching,
    check_gradients,
    floats,
    generator,
    normal,
    poses,
    rotations,
    seeds,
    twists,
    unit_vectors,
)

ANGLES = [0.0, 1e-12, 1e-8, 1e-6, 1e-4, 1e-3, 0.01, 0.0446, 0.0448, 0.1, 0.5, 1.5, 2.1, 3.0, pi - 1e-3, pi - 1e-6]


def grid() -> Tensor:
    """Five directions at every angle, each with a linear part of order one, (angles, 5, 6)."""
    rng = generator(4)
    angular = torch.tensor(ANGLES, dtype=torch.float64)[:, None, None] * unit_vectors((5,), torch.float64, rng)
    return torch.cat((angular, normal((len(ANGLES), 5, 3), torch.float64, rng)), dim=-1)


def ad(twist: Tensor) -> Tensor:
    """The 6x6 matrix of the bracket with a twist, angular first."""
    w, v = so3.hat(twist[..., :3]), so3.hat(twist[..., 3:])
    return torch.cat((torch.cat((w, torch.zeros_like(w)), -1), torch.cat((v, w), -1)), -2)


def test_hat_and_vee() -> None:
    xi = twists((4,), torch.float64, generator(0))
    matrix = se3.hat(xi)
    assert torch.equal(se3.vee(matrix), xi)
    point = normal((4, 3), torch.float64, generator(1))
    velocity = matrix @ torch.cat((point, torch.ones(4, 1)), dim=-1).unsqueeze(-1)
    torch.testing.assert_close(velocity[:, :3, 0], torch.linalg.cross(xi[:, :3], point) + xi[:, 3:])
    assert (velocity[:, 3] == 0).all()


@given(seed=seeds)
def test_exp_matches_matrix_exp(seed: int) -> None:
    xi = twists((20,), torch.float64, generator(seed), max_angle=9.0)
    torch.testing.assert_close(se3.exp(xi), torch.matrix_exp(se3.hat(xi)), rtol=0, atol=1e-13)


@pytest.mark.parametrize("dtype", FLOATS)
def test_exp_and_log_at_every_angle(dtype: torch.dtype) -> None:
    xi, eps = grid(), torch.finfo(dtype).eps
    torch.testing.assert_close(se3.exp(xi.to(dtype)).double(), torch.matrix_exp(se3.hat(xi)), rtol=0, atol=32 * eps)
    torch.testing.assert_close(se3.log(se3.exp(xi).to(dtype)).double(), xi, rtol=0, atol=64 * eps)
    assert torch.equal(se3.exp(torch.zeros(6, dtype=dtype)), torch.eye(4, dtype=dtype))
    assert torch.equal(se3.log(torch.eye(4, dtype=dtype)), torch.zeros(6, dtype=dtype))


@given(seed=seeds, dtype=floats)
def test_exp_undoes_log(seed: int, dtype: torch.dtype) -> None:
    pose = poses((20,), torch.float64, generator(seed))
    back = se3.exp(se3.log(pose.to(dtype)))
    torch.testing.assert_close(back.double(), pose, rtol=0, atol=100 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", FLOATS)
def test_log_of_half_a_turn(dtype: torch.dtype) -> None:
    turns = torch.tensor([[1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1]], dtype=dtype)
    pose = se3.pose(torch.diag_embed(turns), normal((3, 3), dtype, generator(0)))
    torch.testing.assert_close(se3.exp(se3.log(pose)), pose, rtol=0, atol=64 * torch.finfo(dtype).eps)
    assert vmap(jacrev(se3.log))(pose).isfinite().all()
    assert vmap(hessian(se3.log))(pose).isfinite().all()


@pytest.mark.parametrize("angle", ANGLES)
def test_log_of_exp_has_the_derivatives_of_the_identity(angle: float) -> None:
    def round_trip(xi: Tensor) -> Tensor:
        return se3.log(se3.exp(xi))

    xi = grid()[ANGLES.index(angle), :2]
    eye = torch.eye(6, dtype=torch.float64).expand(2, 6, 6)
    torch.testing.assert_close(vmap(jacfwd(round_trip))(xi), eye, rtol=0, atol=1e-11)
    torch.testing.assert_close(vmap(jacrev(round_trip))(xi), eye, rtol=0, atol=1e-11)
    second = vmap(hessian(round_trip))(xi)
    torch.testing.assert_close(second, torch.zeros_like(second), rtol=0, atol=1e-10)


def test_every_mode_of_differentiation_keeps_single_precision() -> None:
    xi = twists((), torch.float32, generator(0))
    for op in (se3.exp, se3.left_jacobian, se3.left_jacobian_inverse, lambda x: se3.log(se3.exp(x))):
        for differentiate in (jacfwd, jacrev, hessian):
            assert differentiate(op)(xi).dtype == torch.float32


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.03, 0.0446, 0.0448, 0.06, 0.3, 2.0])
def test_single_precision_derivatives_of_log_of_exp(angle: float) -> None:
    def round_trip(xi: Tensor) -> Tensor:
        return se3.log(se3.exp(xi))

    angular = angle * unit_vectors((4,), torch.float32, generator(1))
    xi = torch.cat((angular, normal((4, 3), torch.float32, generator(2))), dim=-1)
    first, second = vmap(jacfwd(round_trip))(xi), vmap(hessian(round_trip))(xi)
    torch.testing.assert_close(first, torch.eye(6).expand(4, 6, 6), rtol=0, atol=1e-5)
    torch.testing.assert_close(second, torch.zeros_like(second), rtol=0, atol=3e-4)


def test_gradients_match_finite_differences() -> None:
    rng = generator(6)
    xi = torch.cat((torch.zeros(1, 6), twists((1,), torch.float32, rng)))
    check_gradients(se3.exp, xi)
    check_gradients(se3.log, torch.cat((torch.eye(4, dtype=torch.float64)[None], poses((1,), torch.float64, rng))))
    check_gradients(se3.left_jacobian, xi)
    check_gradients(se3.left_jacobian_inverse, xi)


@given(seed=seeds)
def test_inverse_and_adjoint(seed: int) -> None:
    rng = generator(seed)
    pose, xi = poses((5,), torch.float64, rng), twists((5,), torch.float64, rng)
    eye = torch.eye(4, dtype=torch.float64).expand(5, 4, 4)
    inverse = se3.inverse(pose)
    torch.testing.assert_close(inverse, torch.linalg.inv(pose), rtol=0, atol=1e-13)
    torch.testing.assert_close(inverse @ pose, eye, rtol=0, atol=1e-13)
    adjoint = se3.adjoint(pose)
    carried = (adjoint @ xi.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(se3.hat(carried), pose @ se3.hat(xi) @ inverse, rtol=0, atol=1e-12)
    torch.testing.assert_close(se3.exp(carried), pose @ se3.exp(xi) @ inverse, rtol=0, atol=1e-12)
    torch.testing.assert_close(se3.adjoint(se3.exp(xi)), torch.matrix_exp(ad(xi)), rtol=0, atol=1e-12)
    torch.testing.assert_close(adjoint @ se3.adjoint(inverse), torch.eye(6).double().expand(5, 6, 6))


def test_jacobians_turn_rates_into_velocities() -> None:
    zero = torch.zeros(1, 6, dtype=torch.float64)
    for xi in torch.cat((zero, twists((4,), torch.float64, generator(1), max_angle=6.0))):
        inverse, slope = se3.inverse(se3.exp(xi)), jacfwd(se3.exp)(xi).movedim(-1, 0)
        torch.testing.assert_close(se3.left_jacobian(xi), se3.vee(slope @ inverse).mT, rtol=0, atol=1e-12)
        torch.testing.assert_close(se3.right_jacobian(xi), se3.vee(inverse @ slope).mT, rtol=0, atol=1e-12)


@given(seed=seeds)
def test_left_jacobian_is_the_integral_of_the_adjoint(seed: int) -> None:
    xi = twists((5,), torch.float64, generator(seed), max_angle=6.0)
    # The upper right block of exp [[A, I], [0, 0]] is the integral of exp(s A) over s from 0 to 1, A = ad(xi).
    eye = torch.eye(6, dtype=torch.float64).expand(5, 6, 6)
    augmented = torch.cat((torch.cat((ad(xi), eye), -1), torch.zeros(5, 6, 12, dtype=torch.float64)), -2)
    want = torch.matrix_exp(augmented)[:, :6, 6:]
    torch.testing.assert_close(se3.left_jacobian(xi), want, rtol=0, atol=1e-12)


@given(seed=seeds)
def test_jacobian_identities(seed: int) -> None:
    xi = twists((5,), torch.float64, generator(seed), max_angle=6.0)
    left, right = se3.left_jacobian(xi), se3.right_jacobian(xi)
    eye = torch.eye(6, dtype=torch.float64).expand(5, 6, 6)
    torch.testing.assert_close(left, se3.adjoint(se3.exp(xi)) @ right, rtol=0, atol=1e-12)
    torch.testing.assert_close(right, se3.left_jacobian(-xi), rtol=0, atol=0)
    torch.testing.assert_close(se3.left_jacobian_inverse(xi) @ left, eye, rtol=0, atol=1e-9)
    torch.testing.assert_close(se3.right_jacobian_inverse(xi) @ right, eye, rtol=0, atol=1e-9)


def test_inverse_jacobian_is_the_derivative_of_log() -> None:
    for xi in twists((3,), torch.float64, generator(8)):
        pose = se3.exp(xi)
        turned = jacfwd(lambda small, pose=pose: se3.log(se3.exp(small) @ pose))(torch.zeros(6, dtype=torch.float64))
        torch.testing.assert_close(se3.left_jacobian_inverse(xi), turned, rtol=0, atol=1e-12)


def inverse_times(xi: Tensor, columns: Tensor) -> Tensor:
    return se3.left_jacobian_inverse_times(xi, so3.half_log(so3.exp(xi[..., :3]))[1], columns)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.01, 0.044, 0.046, 0.5, 2.0, 3.1])
@pytest.mark.parametrize("dtype", FLOATS)
def test_inverse_jacobian_times_columns(angle: float, dtype: torch.dtype) -> None:
    rng = generator(9)
    xi = torch.cat((angle * unit_vectors((20,), dtype, rng), normal((20, 3), dtype, rng)), dim=-1)
    columns = normal((20, 6, 5), dtype, rng)
    want = se3.left_jacobian_inverse(xi.double()) @ columns.double()
    atol = 1e-13 if dtype == torch.float64 else 3e-5
    torch.testing.assert_close(inverse_times(xi, columns).double(), want, rtol=0, atol=atol)
    torch.testing.assert_close(inverse_times(xi[0], columns[0]), inverse_times(xi, columns)[0])


@pytest.mark.parametrize(
    "op",
    [
        se3.hat,
        se3.exp,
        se3.left_jacobian,
        se3.right_jacobian,
        se3.left_jacobian_inverse,
        se3.right_jacobian_inverse,
    ],
)
def test_laws_of_twist_operations(op: Callable[[Tensor], Tensor]) -> None:
    check_batching(op, lambda shape, dtype, rng: (twists(shape, dtype, rng, max_angle=2.5),))
    check_bad_row(op, (twists((4,), torch.float32, generator()),))


@pytest.mark.parametrize("op", [se3.vee, se3.log, se3.inverse, se3.adjoint])
def test_laws_of_pose_operations(op: Callable[[Tensor], Tensor]) -> None:
    check_batching(op, lambda shape, dtype, rng: (poses(shape, dtype, rng),))
    check_bad_row(op, (poses((4,), torch.float32, generator()),))


def test_laws_of_pose() -> None:
    def parts(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        return rotations(shape, dtype, rng), normal((*shape, 3), dtype, rng)

    check_batching(se3.pose, parts, shared=(0, 1))
    check_bad_row(se3.pose, parts((4,), torch.float64, generator()))


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ShapeError, match=r"twist must have shape \(\.\.\., 6\), got \(4, 3\)"):
        se3.exp(torch.zeros(4, 3))
    with pytest.raises(ShapeError, match=r"transform must have shape \(\.\.\., 4, 4\), got \(3, 3\)"):
        se3.log(torch.eye(3))
    with pytest.raises(ShapeError, match="leading dimensions do not broadcast: rotation"):
        se3.pose(torch.zeros(2, 3, 3), torch.zeros(5, 3))
