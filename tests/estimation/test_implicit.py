"""Gradients of algorithm 2's fixed point: against differences of the algorithm itself, and rows that have none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ConfigError, GradientError
from apcc_torch.estimation.feedback import Feedback, FeedbackStatus
from apcc_torch.estimation.fit import Problem, evaluate
from apcc_torch.estimation.fixed_point import cost_slope
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple, located
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, PI, configurations
from laws import bits, generator, normal

D = torch.float64
FOUR = torch.tensor([0.08, 0.2, 0.36, 0.55], dtype=D)
TWO = torch.tensor([0.3, 0.55], dtype=D)  # leave freedom, which mode "hierarchical" gives to orientations
MODEL = 1.02 * PI  # no sensor sits on the boundary of a section, where there is a kink
SETTINGS: dict[str, Any] = {"max_iterations": 60, "linear_threshold": 1e-13, "angular_threshold": 1e-12}
SETTINGS |= {"settled_step": 1e-12}
CASES = [("position", FOUR), ("pose", FOUR), ("hierarchical", TWO)]

Solve = Callable[[Tensor, Tensor, Tensor, Tensor], Feedback]


def poses(X: Tensor, rows: int, misfit: float = 1.0) -> tuple[Tensor, Tensor]:
    """Configurations, and poses of sensors that no arm fits by some mm and hundredths of a rad."""
    rng = generator(1)
    q = configurations((rows,), 3, D, rng, bend=0.8)
    scale = misfit * torch.tensor([0.05] * 3 + [5e-3] * 3, dtype=D)
    off = se3.exp(scale * normal((rows, len(X), 6), D, rng))
    return q, PCCBackbone(3, HANGING_BASE).pose(q, PI, *decouple(X, PI)) @ off


def solver(mode: str, seed: Tensor, gradient: str = "implicit", **changed: Any) -> Solve:
    """The estimate as a function of (pi_hat, T, abscissae, angular_weight)."""

    def solve(pi: Tensor, T: Tensor, X: Tensor, weight: Tensor) -> Feedback:
        # Mode "hierarchical" is content with what meets the thresholds, and settles within some steps.
        least = 15 if mode == "hierarchical" else 1
        settings = {"min_iterations": least, **SETTINGS, **changed}
        backbone = PCCBackbone(3, HANGING_BASE)
        return StateFeedback(backbone, X, mode, angular_weight=weight, gradient=gradient, **settings)(seed, pi, T)

    return solve


def outputs(found: Feedback) -> tuple[Tensor, ...]:
    return found.q_bar, found.linear_error, found.angular_error


def leaves(*values: Tensor) -> list[Tensor]:
    return [value.detach().clone().requires_grad_() for value in values]


@pytest.mark.parametrize(("mode", "X"), CASES, ids=[mode for mode, _ in CASES])
def test_gradients_are_those_of_the_algorithm(mode: str, X: Tensor) -> None:
    q, T = poses(X, 2)
    rng = generator(2)
    weight = torch.tensor([0.1, 1.0], dtype=D)
    solve = solver(mode, q)
    found = solve(MODEL, T, X, weight)
    assert (found.status == FeedbackStatus.SETTLED).all() or mode == "hierarchical"
    wanted = [normal(out.shape, D, rng) for out in outputs(found)]
    ways = {
        "pi": lambda s: (MODEL + s, T, X, weight),
        "T": lambda s: (MODEL, T @ se3.exp(s), X, weight),
        "abscissae": lambda s: (MODEL, T, X + s, weight),
        "angular_weight": lambda s: (MODEL, T, X, weight + s),
    }
    sizes = {"pi": (3,), "T": (2, len(X), 6), "abscissae": X.shape, "angular_weight": (2,)}
    for name, moved in ways.items():
        along = normal(sizes[name], D, rng)

        def value(h: float | Tensor, moved: Any = moved, along: Tensor = along) -> Tensor:
            found = outputs(solve(*moved(h * along)))
            return torch.stack([(c * out).sum() for c, out in zip(wanted, found, strict=True)])

        h = 2e-4  # the iteration's own end is only sharp to 1e-9, so a wide step and a difference of order four
        with torch.no_grad():
            near, far = value(h) - value(-h), value(2 * h) - value(-2 * h)
        want = (8.0 * near - far) / (12.0 * h)
        s = torch.zeros((), dtype=D, requires_grad=True)
        outs = value(s) + 0.0 * s  # some outputs do not depend on some inputs
        have = torch.stack([torch.autograd.grad(out, s, retain_graph=True)[0] for out in outs])
        torch.testing.assert_close(have, want, rtol=1e-4, atol=2e-5, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.parametrize("mode", ["position", "pose"])
def test_unrolled_agrees_and_so_does_the_sensitivity_with_its_residual(mode: str) -> None:
    for misfit, lacking in ((0.0, 1e-6), (1.0, None)):
        q, T = poses(FOUR, 3, misfit)
        pi_hat = PI if misfit == 0.0 else MODEL
        slopes = []
        for gradient in ("implicit", "unrolled"):
            (pi,) = leaves(pi_hat.expand(3, 3))
            q_bar = solver(mode, q + 0.05, gradient)(pi, T, FOUR, torch.tensor(1.0, dtype=D)).q_bar
            columns = [torch.autograd.grad(q_bar[:, i].sum(), pi, retain_graph=True)[0] for i in range(9)]
            slopes.append(torch.stack(columns, dim=-2))
        scale = float(slopes[1].abs().max())
        assert float((slopes[0] - slopes[1]).abs().max()) < 1e-4 * scale
        estimator = StateFeedback(PCCBackbone(3, HANGING_BASE), FOUR, mode)
        exact, fitted = (estimator.sensitivity(q_bar.detach(), pi_hat, T=seen) for seen in (T, None))
        assert float((exact - slopes[0]).abs().max()) < 1e-6 * scale
        gap = float((fitted - slopes[0]).abs().max()) / scale
        assert gap < lacking if lacking is not None else gap > 1e-2


def test_the_seed_gets_nothing_and_the_values_are_those_without_gradients() -> None:
    q, T = poses(FOUR, 3)
    seed, pi, sensors = leaves(q + 0.05, MODEL.expand(3, 3), T)
    estimator = StateFeedback(PCCBackbone(3, HANGING_BASE), FOUR)
    with_graph = estimator(seed, pi, sensors)
    with torch.no_grad():
        without = estimator(seed, pi, sensors)
    for have, want in zip(with_graph, without, strict=True):
        assert torch.equal(bits(have), bits(want))
    with_graph.q_bar.sum().backward()
    assert float(seed.grad.abs().max()) == 0.0 and float(pi.grad.abs().max()) > 0.1
    assert not estimator(q, MODEL, T).q_bar.requires_grad


def test_rows_without_a_fixed_point_are_constants_and_harm_no_one() -> None:
    q, T = poses(FOUR, 5)
    T[3] = torch.nan
    bad_seed = q.clone()
    bad_seed[4] = torch.nan
    bad_seed[2] = 0.9  # far off: three steps do not bring it home
    settings = {"max_iterations": 3, "linear_threshold": 1e-13, "settled_step": 2e-3}

    def gradients(rows: Any) -> tuple[Feedback, Tensor, Tensor, Tensor]:
        seed, shared, sensors = leaves(bad_seed[rows], MODEL, T[rows])
        found = solver("pose", seed, **settings)(shared, sensors, FOUR, torch.tensor(0.1, dtype=D))
        (found.q_bar.square().sum(-1) + found.linear_error.sum(-1)).nansum().backward()
        return found, seed.grad, shared.grad, sensors.grad

    found, seed_grad, shared_grad, sensor_grad = gradients(slice(None))
    S = FeedbackStatus
    assert found.status.tolist() == [S.SETTLED, S.SETTLED, S.ITERATION_LIMIT, S.INVALID, S.INVALID]
    _, _, alone, sensors_alone = gradients(slice(2))
    torch.testing.assert_close(shared_grad, alone, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(sensor_grad[:2], sensors_alone, rtol=1e-12, atol=1e-14)
    assert float(sensor_grad[2:].abs().max()) == 0.0
    # An invalid row is its seed.
    torch.testing.assert_close(seed_grad[3], 2.0 * q[3], rtol=1e-12, atol=0)
    assert float(seed_grad[:3].abs().max()) == 0.0


def test_masked_sensors_get_no_gradient() -> None:
    q, T = poses(FOUR, 2)
    mask = torch.tensor([True, False, True, True])
    T[:, 1] = torch.nan
    pi, sensors = leaves(MODEL, T)
    StateFeedback(PCCBackbone(3, HANGING_BASE), FOUR)(q, pi, sensors, mask).q_bar.sum().backward()
    assert torch.isfinite(pi.grad).all() and torch.isfinite(sensors.grad).all()
    assert float(sensors.grad[:, 1].abs().max()) == 0.0 and float(sensors.grad[:, 0].abs().max()) > 0.1


def test_a_second_derivative_is_refused_and_unrolled_gives_it() -> None:
    q, T = poses(FOUR, 1)
    for gradient in ("implicit", "unrolled"):
        (pi,) = leaves(MODEL)
        q_bar = solver("pose", q, gradient)(pi, T, FOUR, torch.tensor(1.0, dtype=D)).q_bar
        (first,) = torch.autograd.grad(q_bar.sum(), pi, create_graph=True)
        if gradient == "implicit":
            with pytest.raises(GradientError, match="unrolled"):
                torch.autograd.grad(first.sum(), pi)
        else:
            assert torch.isfinite(torch.autograd.grad(first.sum(), pi)[0]).all()


def test_functional_gradients_and_single_precision() -> None:
    q, T = poses(FOUR, 2)
    weight = torch.tensor(0.1, dtype=D)
    settings = {"linear_threshold": 1e-6, "settled_step": 1e-5}
    solve = solver("pose", q, **settings)
    functional = torch.func.grad(lambda pi: solve(pi, T, FOUR, weight).q_bar.square().sum())(MODEL)
    (pi,) = leaves(MODEL)
    solve(pi, T, FOUR, weight).q_bar.square().sum().backward()
    torch.testing.assert_close(functional, pi.grad)
    single = MODEL.float().requires_grad_()
    weight = weight.float()
    solver("pose", q.float(), **settings)(single, T.float(), FOUR.float(), weight).q_bar.square().sum().backward()
    assert single.grad.dtype == torch.float32
    torch.testing.assert_close(single.grad.double(), pi.grad, rtol=1e-3, atol=1e-3)


def test_an_unknown_gradient_is_refused() -> None:
    with pytest.raises(ConfigError, match="gradient must be one of implicit, unrolled"):
        StateFeedback(PCCBackbone(3, HANGING_BASE), FOUR, gradient="exact")


@pytest.mark.parametrize("mode", ["pose", "position"])
def test_the_closed_form_is_the_slope_of_the_gradient(mode: str) -> None:
    """Against autograd on the sum of weighted squares, with sensors that see nothing or no orientation."""
    backbone, rows = PCCBackbone(3, HANGING_BASE), 9
    q, T = poses(FOUR, rows)
    rng = generator(4)
    usable = torch.rand(rows, len(FOUR), generator=rng) > 0.2
    oriented = usable & (torch.rand(rows, len(FOUR), generator=rng) > 0.2)
    weights = usable.to(D)[..., None, None] * torch.tensor([0.3] * 3 + [1.0] * 3, dtype=D).unsqueeze(-1)
    angular = torch.arange(6).unsqueeze(-1) < 3
    weights = torch.where(angular & ~oriented[..., None, None], 0.0, weights)
    if mode == "position":
        weights = torch.where(angular, 0.0, weights)
    pi = PI.expand(rows, 3)
    points = backbone.material_points(pi, *located(FOUR.expand(rows, 4), pi))
    problem = Problem(T[..., :3, :3], T[..., :3, 3], points, usable, oriented, weights)

    def cost(at: Tensor) -> Tensor:
        return 0.5 * (weights.squeeze(-1) * evaluate(backbone, mode, at, problem).twist).square().sum()

    at = q + 0.05 * normal(q.shape, D, rng) * torch.tensor([1.0, 1.0, 0.05] * 3, dtype=D)
    have = cost_slope(backbone, mode, at, problem)
    want = torch.stack([torch.autograd.functional.hessian(cost, at)[r, :, r] for r in range(rows)])
    torch.testing.assert_close(have, want, rtol=1e-9, atol=1e-9 * float(want.abs().max()))
