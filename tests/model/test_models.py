"""Every kinematic model under the same laws: tangent, one curve, Jacobians, linearity, batching, the straight pose."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import jacfwd, jvp, vmap

from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.model.tendons import rack_routing
from arms import rest_lengths
from kinematic_models import MODELS, STRAIN_ERROR, random_model, random_rows, shapes_of
from laws import check_bad_row, check_batching, check_gradients, generator, normal, seeds, uniform

D = torch.float64
every_model = pytest.mark.parametrize("name", list(MODELS))
sections = st.integers(1, 4)


def along(L0: Tensor, k: int, seed: int) -> Tensor:
    """k material abscissae inside the arm, in order, m."""
    return (uniform((k,), 0.01, 0.99, L0.dtype, generator(seed)) * L0.sum()).sort().values


def body_twists(model: KinematicModel, q: Tensor, L0: Tensor, X: Tensor, rates: Tensor) -> Tensor:
    """hat^-1(T^-1 Tdot) (..., k, 6, c) of poses whose derivatives are `rates` (..., k, 4, 4, c)."""
    inverse = se3.inverse(model.pose(q, L0, *decouple(X, L0)))
    return torch.stack([se3.vee(inverse @ rates[..., i]) for i in range(rates.shape[-1])], dim=-1)


@every_model
@given(seed=seeds, n=sections)
def test_the_frame_moves_along_its_strain(name: str, seed: int, n: int) -> None:
    model, q, L0 = random_model(name, seed, n)
    X = along(L0, 8, seed)
    X_tilde, j = decouple(X, L0)
    pose, rate = jvp(lambda X: model.pose(q, L0, *decouple(X, L0)), (X,), (torch.ones_like(X),))
    strain = model.strain(q, L0, model.material_points(L0, X_tilde, j)) / L0[j].unsqueeze(-1)
    moved = se3.vee(se3.inverse(pose) @ rate)
    torch.testing.assert_close(moved, strain, rtol=0, atol=STRAIN_ERROR.get(name, 1e-11))
    # Without shear the tangent is the frame's z axis, and its length is that of the curve.
    if not any("shear" in c.name for c in model.coordinates.pattern):
        across = moved[:, 3:5]
        torch.testing.assert_close(across, torch.zeros_like(across), rtol=0, atol=STRAIN_ERROR.get(name, 1e-11))
    per_metre = model.section_lengths(q, L0) / L0
    torch.testing.assert_close(moved[:, 3:].norm(dim=-1), per_metre[j], rtol=0, atol=STRAIN_ERROR.get(name, 1e-11))


@every_model
@given(seed=seeds, n=sections)
def test_tip_pose_points_and_curve_are_one(name: str, seed: int, n: int) -> None:
    model, q, L0 = random_model(name, seed, n)
    end = model.pose(q, L0, torch.ones(1).double(), torch.tensor([n - 1]))[0]
    torch.testing.assert_close(end[:3, 3], model.tip(q, L0), rtol=0, atol=1e-13)
    torch.testing.assert_close(end[:3, :3] @ end[:3, :3].mT, torch.eye(3).double(), rtol=0, atol=1e-12)
    if n > 1:  # sections meet in one frame
        joint = torch.arange(n - 1)
        whole = torch.ones(n - 1).double()
        ending = model.pose(q, L0, whole, joint)
        torch.testing.assert_close(
            ending, model.pose(q, L0, torch.zeros(n - 1).double(), joint + 1), rtol=0, atol=1e-13
        )
    together = model.tip_and_jacobian(q, L0)
    assert torch.equal(together[0], model.tip(q, L0)) and torch.equal(together[1], model.tip_jacobian(q, L0))
    where = decouple(along(L0, 5, seed), L0)
    torch.testing.assert_close(
        model.pose_and_body_jacobian(q, L0, *where)[0], model.pose(q, L0, *where), rtol=0, atol=1e-13
    )
    for spacing in ("arc", "material"):
        points = model.points(q, L0, 9, spacing)
        torch.testing.assert_close(points[-1], model.tip(q, L0), rtol=0, atol=1e-13)
        assert float(points[0].norm()) < 1e-15
    curve = model.curve(q[None], L0[None], torch.linspace(0.0, 1.0, 9).double())[0].mT
    torch.testing.assert_close(curve, model.points(q, L0, 9), rtol=0, atol=1e-12)


@every_model
@settings(max_examples=2)
@given(seed=seeds)
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_jacobians_are_the_derivatives_of_poses(name: str, n: int, seed: int) -> None:
    model, q, L0, qdot = random_rows(name, seed, n, rows=4)
    X = torch.stack([along(row, 4, seed) for row in L0])
    where = decouple(X, L0)

    def pose(q: Tensor, L0: Tensor, X: Tensor) -> Tensor:
        return model.pose(q, L0, *decouple(X, L0))

    torch.testing.assert_close(model.tip_jacobian(q, L0), vmap(jacfwd(model.tip))(q, L0), rtol=0, atol=1e-12)
    body = model.body_jacobian(q, L0, *where)
    want = body_twists(model, q, L0, X, vmap(jacfwd(pose))(q, L0, X))
    torch.testing.assert_close(body, want, rtol=0, atol=1e-12)
    _, rate = jvp(lambda q: model.tip_jacobian(q, L0), (q,), (qdot,))
    torch.testing.assert_close(model.tip_jacobian_rate(q, qdot, L0), rate, rtol=0, atol=1e-11)
    # A longer section moves what it carries, and slides points along their strain: known as well as the strain is.
    moved = model.body_parameter_jacobian(q, L0, X, body)
    want = body_twists(model, q, L0, X, vmap(jacfwd(pose, argnums=1))(q, L0, X))
    torch.testing.assert_close(moved, want, rtol=0, atol=STRAIN_ERROR.get(name, 1e-11))


@every_model
@given(seed=seeds, n=sections)
def test_the_last_of_chains_to_points_is_the_whole_arm(name: str, seed: int, n: int) -> None:
    model, q, L0 = random_model(name, seed, n)
    points = model.material_points(L0, *decouple(along(L0, 3, seed), L0)).with_tip(L0)
    last, whole = model.chain_to(q, points).at(-1), model.chain(q, L0)
    qdot = normal((model.n,), D, generator(seed))
    for have, want in (
        (last.tip, whole.tip),
        (last.rotation, whole.rotation),
        (last.tip_jacobian(), whole.tip_jacobian()),
        (last.body_jacobian(), whole.body_jacobian()),
        (last.jacobian_rate(qdot), whole.jacobian_rate(qdot)),
    ):
        torch.testing.assert_close(have, want, rtol=0, atol=1e-12)


@every_model
@settings(max_examples=2)
@given(seed=seeds)
@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_tips_velocity_is_linear_in_the_rest_lengths(name: str, n: int, seed: int) -> None:
    model, q, L0, qdot = random_rows(name, seed, n, rows=5)

    def velocity(q: Tensor, L0: Tensor, qdot: Tensor) -> Tensor:
        return jacfwd(model.tip)(q, L0) @ qdot

    def bent(q: Tensor, L0: Tensor, qdot: Tensor) -> Tensor:
        return jacfwd(jacfwd(lambda L0: model.tip_jacobian(q, L0) @ qdot))(L0)

    def of(lengths: Tensor) -> Tensor:
        return (model.tip_jacobian(q, lengths) @ qdot.unsqueeze(-1)).squeeze(-1)

    Y, Phi = model.regressor(q, qdot)
    predicted = (Y @ L0.unsqueeze(-1)).squeeze(-1) + Phi
    torch.testing.assert_close(predicted, vmap(velocity)(q, L0, qdot), rtol=0, atol=1e-11)
    torch.testing.assert_close(Y, vmap(jacfwd(velocity, argnums=1))(q, L0, qdot), rtol=0, atol=1e-11)
    torch.testing.assert_close(Phi, vmap(velocity)(q, torch.zeros_like(L0), qdot), rtol=0, atol=1e-11)
    curvature = vmap(bent)(q, L0, qdot)
    torch.testing.assert_close(curvature, torch.zeros_like(curvature), rtol=0, atol=1e-11)
    other = rest_lengths((5,), n, D, generator(seed + 1))
    moved = (Y @ (L0 - other).unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(moved, of(L0) - of(other), rtol=0, atol=1e-11)


@every_model
def test_first_and_second_derivatives_at_the_straight_pose(name: str) -> None:
    model = MODELS[name](2, None)
    L0, q = torch.tensor([0.1, 0.2], dtype=D), torch.zeros(model.n, dtype=D)
    qdot, where = normal((model.n,), D, generator(0)), decouple(torch.tensor([0.05, 0.25], dtype=D), L0)
    check_gradients(model.tip, q, L0)
    check_gradients(lambda q: model.body_jacobian(q, L0, *where), q)
    check_gradients(model.regressor, q, qdot)
    rate = jvp(lambda q: jacfwd(model.tip)(q, L0), (q,), (qdot,))[1]
    torch.testing.assert_close(model.tip_jacobian_rate(q, qdot, L0), rate, rtol=0, atol=1e-13)
    # Continuous there: from configurations ever nearer to the straight one the same numbers.
    for size in (1e-4, 1e-8, 1e-160):
        near = model.tip_jacobian_rate(size * qdot, qdot, L0)
        torch.testing.assert_close(near, rate, rtol=0, atol=10.0 * size + 1e-15)


@every_model
def test_leading_dimensions_are_a_batch(name: str) -> None:
    model = MODELS[name](3, None)

    def make(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
        q, L0 = shapes_of(model, shape, dtype, rng), rest_lengths(shape, 3, dtype, rng)
        return q, L0, normal((*shape, model.n), dtype, rng), uniform((*shape, 4), 0.01, 0.5, dtype, rng)

    def op(q: Tensor, L0: Tensor, qdot: Tensor, X: Tensor) -> tuple[Any, ...]:
        where = decouple(X, L0)
        pose, body = model.pose_and_body_jacobian(q, L0, *where)
        routing = rack_routing(q.new_tensor([0.1, 0.2, 0.4]))
        return (
            model.tip_and_jacobian(q, L0),
            model.tip_jacobian_rate(q, qdot, L0),
            model.pose(q, L0, *where),
            pose,
            body,
            model.body_parameter_jacobian(q, L0, X, body),
            model.regressor(q, qdot),
            model.points(q, L0, 7),
            model.tendon_lengths(routing, q, L0),
        )

    check_batching(op, make, shared=(0, 1), scale=30.0)
    check_bad_row(op, make((3,), D, generator(1)))


@every_model
@settings(max_examples=20)
@given(seed=seeds, n=st.integers(1, 3))
def test_tendons_lengthen_as_their_paths_do(name: str, seed: int, n: int) -> None:
    # A tendon beside the backbone, drawn through the model's own poses: its length, to first order in q.
    model, q, L0 = random_model(name, seed, n)
    routing = rack_routing(torch.tensor([0.6, 0.9], dtype=D) * L0.sum(), layout="independent")
    share = torch.linspace(0.0, 1.0, 2001, dtype=D)

    def length(q: Tensor, tendon: int) -> Tensor:
        begin, end = routing.starts[tendon], routing.anchors[tendon]
        pose = model.pose(q, L0, *decouple(begin + share * (end - begin), L0))
        angle, d = routing.angles[tendon], routing.offsets[tendon]
        beside = torch.stack((d * torch.cos(angle), d * torch.sin(angle), torch.zeros_like(d)))
        path = pose[:, :3, 3] + pose[:, :3, :3] @ beside
        return path.diff(dim=0).norm(dim=-1).sum()

    B = model.tendon_matrix(routing, L0)
    straight = torch.zeros_like(q)
    for tendon in (0, 4):
        slope = torch.func.grad(lambda q, t=tendon: length(q, t))(straight)
        torch.testing.assert_close(B[:, tendon], slope, rtol=0, atol=2e-3)
    lengths = model.tendon_lengths(routing, q, L0)
    torch.testing.assert_close(lengths, B.mT @ q)


@pytest.mark.parametrize("name", sorted(set(MODELS) - {"mixed"}))
def test_a_model_of_another_number_of_sections(name: str) -> None:
    model = MODELS[name](3, None)
    fewer = model.resized(2)
    assert type(fewer) is type(model) and fewer.n_sections == 2 and fewer.n == 2 * model.n // 3
    assert fewer.coordinates == model.coordinates


@every_model
def test_bad_input_is_named(name: str) -> None:
    model = MODELS[name](3, None)
    q, L0 = torch.zeros(model.n, dtype=D), torch.full((3,), 0.1, dtype=D)
    with pytest.raises(ShapeError, match="q must have shape"):
        model.tip(q[1:], L0)
    with pytest.raises(ShapeError, match="L0 must have shape"):
        model.tip_jacobian(q, L0[:2])
    with pytest.raises(DtypeError, match=r"q is torch.float64 but L0 is torch.float32"):
        model.tip(q, L0.float())
    with pytest.raises(ShapeError, match="qdot must have shape"):
        model.regressor(q, q[:1])
    with pytest.raises(ValueRangeError, match="N must be at least 2"):
        model.points(q, L0, 1)
    with pytest.raises(ValueRangeError, match="n_sections must be at least 1"):
        MODELS[name](0, None)
