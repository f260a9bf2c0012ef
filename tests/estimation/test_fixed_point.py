"""The exact derivative of algorithm 2's fixed point on loaded arms: against differences of an oracle's fixed points."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from torch import Tensor
from torch.func import grad, jacfwd, vmap

from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import se3, so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.constant_strain import ConstantStrainBackbone
from apcc_torch.model.kinematic_model import KinematicModel
from arms import HANGING_BASE, PI
from resting_arms import at_rest

D = torch.float64
TIGHT = {"max_iterations": 400, "min_iterations": 15, "linear_threshold": 1e-15, "angular_threshold": 1e-15}
TIGHT |= {"settled_step": 1e-14}


class Layout(NamedTuple):
    """A model of the true arm, of six sections that hang under a payload: lengths pi and sensors X, m."""

    model: KinematicModel
    pi: list[float]
    X: list[float]


def pcc(n: int) -> PCCBackbone:
    return PCCBackbone(n, HANGING_BASE)


LAYOUTS = {
    "paper": Layout(pcc(3), [0.11, 0.27, 0.24], [0.105, 0.36, 0.6]),
    "within": Layout(pcc(3), [0.11, 0.27, 0.24], [0.08, 0.2, 0.36, 0.55]),
    "two": Layout(pcc(2), [0.2, 0.41], [0.12, 0.31, 0.44, 0.59]),
    "four": Layout(pcc(4), [0.11, 0.16, 0.13, 0.21], [0.06, 0.1, 0.19, 0.25, 0.37, 0.45, 0.58]),
    "free": Layout(pcc(3), [0.11, 0.27, 0.24], [0.3, 0.55]),
    "affine": Layout(AffineBackbone(2, HANGING_BASE, rods=2), [0.25, 0.36], [0.1, 0.2, 0.31, 0.44, 0.59]),
    "torsion": Layout(
        ConstantStrainBackbone(2, HANGING_BASE, ("bend_x", "bend_y", "torsion", "elongation")),
        [0.25, 0.36],
        [0.1, 0.31, 0.44, 0.59],
    ),
}
TRUE = PI.repeat_interleave(2) * torch.tensor([0.45, 0.55] * 3, dtype=D)


def loaded(rows: int) -> tuple[Tensor, Tensor]:
    """Equilibria of the true arm under tendons and a payload of 0.2 kg at its tip: q (rows, 18), lengths."""
    return at_rest(rows, payload=torch.tensor(0.2, dtype=D), lengths=TRUE).q, TRUE


def residuals(model: KinematicModel, X: Tensor, T: Tensor, q: Tensor, pi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Positions m, orientations rad and the logarithm of Eq. (30), from sensor to model, each (k, .)."""
    at = model.pose(q, pi, *decouple(X, pi))
    return (
        (at - T)[:, :3, 3],
        so3.log(T[:, :3, :3].mT @ at[:, :3, :3]),
        se3.log(se3.inverse(at) @ T),
    )


def oracle(mode: str, weight: float, layout: Layout, T: Tensor, q: Tensor, pi: Tensor) -> Tensor:
    """The fixed point near q (n,), by Newton's method on the equations that say what it is."""
    X = torch.tensor(layout.X, dtype=D)

    def position(q: Tensor, pi: Tensor) -> Tensor:
        return 0.5 * residuals(layout.model, X, T, q, pi)[0].square().sum()

    def orientation(q: Tensor, pi: Tensor) -> Tensor:
        return 0.5 * residuals(layout.model, X, T, q, pi)[1].square().sum()

    def pose(q: Tensor, pi: Tensor) -> Tensor:
        V = residuals(layout.model, X, T, q, pi)[2]
        return 0.5 * (weight**2 * V[:, :3].square().sum() + V[:, 3:].square().sum())

    def equations(q: Tensor, pi: Tensor) -> Tensor:
        if mode != "hierarchical":
            return grad(pose if mode == "pose" else position)(q, pi)
        J = jacfwd(lambda q: residuals(layout.model, X, T, q, pi)[0].flatten())(q)
        seen = torch.linalg.pinv(J, rtol=1e-9) @ J
        g = grad(orientation)(q, pi)
        return grad(position)(q, pi) + g - seen @ g

    for _ in range(3):
        q = q - torch.linalg.solve(jacfwd(equations)(q, pi), equations(q, pi))
    return q


def differences(mode: str, weight: float, layout: Layout, T: Tensor, q: Tensor, pi: Tensor) -> Tensor:
    """dq_bar/dpi (n, n_b), central and of order four."""
    h = 2e-4
    steps = h * torch.eye(len(pi), dtype=D)
    at = torch.cat([pi + s * steps for s in (-2, -1, 1, 2)])
    found = vmap(lambda pi: oracle(mode, weight, layout, T, q, pi))(at).unflatten(0, (4, -1))
    return ((found[0] - found[3] + 8.0 * (found[2] - found[1])) / (12.0 * h)).mT


CASES = [
    ("position", 1.0, "within"),
    ("position", 1.0, "two"),
    ("pose", 1.0, "paper"),
    ("pose", 0.03, "four"),
    ("pose", 1.0, "affine"),
    ("pose", 0.03, "torsion"),
    ("hierarchical", 1.0, "free"),
]


@pytest.mark.parametrize(("mode", "weight", "name"), CASES)
def test_the_sensitivity_is_that_of_the_fixed_point(mode: str, weight: float, name: str) -> None:
    layout = LAYOUTS[name]
    q_true, lengths = loaded(1)
    X, pi = (torch.tensor(v, dtype=D) for v in (layout.X, layout.pi))
    T = pcc(6).pose(q_true, lengths, *decouple(X, lengths))[0]
    f = StateFeedback(layout.model, X, mode, angular_weight=weight, **TIGHT)
    q_bar = f(torch.zeros(layout.model.n, dtype=D), pi, T).q_bar
    q = oracle(mode, weight, layout, T, q_bar, pi)
    assert float((q - q_bar).abs().max()) < 1e-7  # algorithm 2 ends at the oracle's fixed point
    want = differences(mode, weight, layout, T, q, pi)
    have = f.sensitivity(q, pi, T=T)
    assert float((have - want).norm() / want.norm()) < 1e-6
    # Each layout leaves a residual that counts.
    assert float((f.sensitivity(q, pi) - want).norm() / want.norm()) > 5e-3


def test_a_fixed_point_that_does_not_attract_has_the_derivative_of_one_step() -> None:
    # Sensors seen from the inside of their bend: the residual's share outweighs the Gauss-Newton matrix.
    layout = LAYOUTS["paper"]
    X, pi = (torch.tensor(v, dtype=D) for v in (layout.X, layout.pi))
    f = StateFeedback(layout.model, X, "position")
    q = torch.tensor([[0.4, 0.1, 0.0] * 3, [0.4, 0.1, 0.0] * 3], dtype=D)
    T = layout.model.pose(q, pi, *decouple(X, pi))
    T[1, :, :3, 3] += 3.0 * T[1, :, :3, 3] / T[1, :, :3, 3].norm(dim=-1, keepdim=True)
    T[1, :, :3, 3] *= -1.0
    have = f.sensitivity(q, pi, T=T)
    points = layout.model.material_points(pi, *decouple(X, pi))
    J = layout.model.chain_to(q[1], points).body_jacobian()[:, 3:]

    def gradient(pi: Tensor) -> Tensor:
        at = layout.model.pose(q[1], pi, *decouple(X, pi))
        J = layout.model.body_jacobian(q[1], pi, *decouple(X, pi))[:, 3:]
        off = at[:, :3, :3].mT @ (at - T[1])[:, :3, 3:]
        return (J.mT @ off).sum(0).squeeze(-1)

    step = -torch.linalg.solve((J.mT @ J).sum(0), jacfwd(gradient)(pi))
    torch.testing.assert_close(have[1], step, rtol=1e-6, atol=1e-6 * float(step.abs().max()))
    torch.testing.assert_close(have[0], f.sensitivity(q[0], pi), rtol=1e-9, atol=1e-9)  # and harms no one
