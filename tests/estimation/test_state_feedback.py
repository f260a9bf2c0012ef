"""Algorithm 2 on sensors whose configuration is known, and on sensors that no configuration fits."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.func import jacfwd

from apcc_torch.errors import ApccError, ConfigError, DtypeError, ShapeError, ValueRangeError
from apcc_torch.estimation.feedback import Feedback, FeedbackStatus
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import se3, so3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, PI, configurations
from laws import bits, generator, leaves, normal, rotation_vectors, uniform

MODES = ("position", "pose", "hierarchical")
# Table I [Dalenberg]: measured and sampled rest lengths of the eight runs, m.
TABLE_I = torch.tensor(
    [
        [[0.114, 0.246, 0.245], [0.127, 0.245, 0.252]],
        [[0.114, 0.246, 0.245], [0.094, 0.253, 0.226]],
        [[0.105, 0.245, 0.245], [0.102, 0.255, 0.259]],
        [[0.106, 0.244, 0.245], [0.100, 0.218, 0.231]],
        [[0.105, 0.245, 0.245], [0.103, 0.271, 0.259]],
        [[0.105, 0.245, 0.245], [0.125, 0.255, 0.267]],
        [[0.065, 0.244, 0.244], [0.079, 0.257, 0.270]],
        [[0.066, 0.245, 0.245], [0.084, 0.254, 0.260]],
    ],
    dtype=torch.float64,
)


def feedback(mode: str = "pose", abscissae: Tensor | None = None, **settings: Any) -> StateFeedback:
    abscissae = PI.cumsum(0) if abscissae is None else abscissae
    return StateFeedback(PCCBackbone(3, HANGING_BASE), abscissae, mode, **settings)


def measured(estimator: StateFeedback, q: Tensor, pi: Tensor = PI) -> Tensor:
    """Poses (..., k, 4, 4) of the estimator's sensors on an arm of rest lengths pi."""
    return estimator.backbone.pose(q, pi, *decouple(estimator.abscissae, pi))


def problems(rows: int, seed: int, off: float = 0.3) -> tuple[Tensor, Tensor]:
    """Configurations bent up to 1.2 rad in each direction and stretched up to 10 %, and seeds up to `off` rad away."""
    rng = generator(seed)
    q = configurations((rows,), 3, torch.float64, rng, elongation=1.0).unflatten(-1, (3, 3))
    q[..., 2] *= 0.1 * PI
    away = uniform((rows, 3, 3), -off, off, torch.float64, rng)
    away[..., 2] = 0.0
    return q.flatten(-2), (q + away).flatten(-2)


def misfit(rows: int, k: int, seed: int) -> tuple[Tensor, Tensor]:
    """Configurations, and twists that put k sensors a few mm and hundredths of a rad off any arm."""
    rng = generator(seed)
    q = configurations((rows,), 3, torch.float64, rng, bend=0.8)
    scale = torch.tensor([0.05] * 3 + [5e-3] * 3, dtype=torch.float64)
    return q, se3.exp(scale * normal((rows, k, 6), torch.float64, rng))


@pytest.mark.parametrize("mode", MODES)
def test_recovers_a_thousand_shapes(mode: str) -> None:
    q, seed = problems(1000, seed=0)
    # Both thresholds are reached by every row with the paper's N = 7 steps to spare.
    estimator = feedback(mode)
    result = estimator(seed, PI, measured(estimator, q))
    assert int((result.status == FeedbackStatus.CONVERGED).sum()) == 1000
    assert float(result.linear_error.max()) < estimator.linear_threshold
    assert float(result.angular_error.max()) < estimator.angular_threshold
    # Within the thresholds many configurations pass; tight ones leave the true one.
    estimator = feedback(mode, linear_threshold=1e-9, angular_threshold=1e-8)
    result = estimator(seed, PI, measured(estimator, q))
    assert int((result.status == FeedbackStatus.CONVERGED).sum()) == 1000
    assert int(result.iterations.max()) <= 7
    assert float((result.q_bar - q).abs().max()) < 1e-6


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("sensors", [[0, 1, 2], [0, 2], [2]])
def test_single_precision_converges_as_double_does(mode: str, sensors: list[int]) -> None:
    # With few sensors the normal matrix is singular but for its damping, which must not vanish in rounding.
    q, seed = problems(300, seed=1)
    estimator = feedback(mode, PI.cumsum(0)[sensors])
    T = measured(estimator, q)
    double, single = estimator(seed, PI, T), estimator(seed.float(), PI.float(), T.float())
    assert single.q_bar.dtype == torch.float32
    met = [int((result.status == FeedbackStatus.CONVERGED).sum()) for result in (double, single)]
    # One sensor alone asks some rows for sections of next to no length, which take longer.
    assert min(met) >= (300 if len(sensors) > 1 else 290)
    mean = [result.iterations.double().mean() for result in (double, single)]
    assert float(mean[1]) < float(mean[0]) + 0.05


def test_thresholds_are_both_awaited() -> None:
    q, seed = problems(50, seed=2)
    for loose in ("linear_threshold", "angular_threshold"):
        estimator = feedback("pose", **{"linear_threshold": 1e-9, "angular_threshold": 1e-8, loose: 10.0})
        result = estimator(seed, PI, measured(estimator, q))
        assert (result.status == FeedbackStatus.CONVERGED).all()
        assert float((result.q_bar - q).abs().max()) < 1e-6


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("parameters", [0, 1])
def test_table_1(mode: str, parameters: int) -> None:
    # The arm has the measured rest lengths and carries sensors at its section ends; the model has the measured or the
    # sampled ones. The eight runs are one batch.
    pi, pi_hat = TABLE_I[:, 0], TABLE_I[:, parameters]
    for draw in range(4):
        q = configurations((8,), 3, torch.float64, generator(draw), bend=(0.0, 0.4, 0.8, 1.2)[draw])
        for row in range(8):
            estimator = feedback(mode, pi[row].cumsum(0), max_iterations=20)
            T = measured(estimator, q[row], pi[row])
            result = estimator(torch.zeros(9).double(), pi_hat[row], T)
            assert torch.isfinite(result.q_bar).all()
            assert result.status in (FeedbackStatus.CONVERGED, FeedbackStatus.SETTLED, FeedbackStatus.ITERATION_LIMIT)
            if parameters == 0:
                assert result.status == FeedbackStatus.CONVERGED
                continue
            # Another model cannot fit three poses, but stays within the difference of the two models.
            if mode == "pose":
                assert float(result.linear_error.max()) < 0.05 and float(result.angular_error.max()) < 0.5
            else:
                assert float(result.linear_error.max()) < 1e-4


@pytest.mark.parametrize("mode", MODES)
def test_masked_sensor_is_a_missing_sensor(mode: str) -> None:
    q, seed = problems(6, seed=3)
    X = torch.tensor([0.08, 0.2, 0.36, 0.6], dtype=torch.float64)
    full, fewer = feedback(mode, X), feedback(mode, X[[0, 2, 3]])
    T = measured(full, q)
    want = fewer(seed, PI, T[:, [0, 2, 3]])
    mask = torch.tensor([True, False, True, True])
    masked = full(seed, PI, T, mask)
    torch.testing.assert_close(masked.q_bar, want.q_bar, rtol=0, atol=1e-9)
    assert torch.equal(masked.iterations, want.iterations) and torch.equal(masked.status, want.status)
    assert float(masked.linear_error[:, 1].abs().max()) == float(masked.angular_error[:, 1].abs().max()) == 0.0
    # Whatever a masked sensor says, and however it says that it knows nothing, the answer is the same to the bit.
    for nonsense in (torch.nan, torch.inf, 1e6):
        other = T.clone()
        other[:, 1] = nonsense
        for have, was in zip(leaves(full(seed, PI, other, mask)), leaves(masked), strict=True):
            assert torch.equal(bits(have), bits(was))
    gap = T.clone()
    gap[:, 1, 0, 3] = torch.nan
    for have, was in zip(leaves(full(seed, PI, gap)), leaves(masked), strict=True):
        assert torch.equal(bits(have), bits(was))


def test_masked_orientation_has_no_say() -> None:
    q, seed = problems(20, seed=4)
    for mode in ("pose", "hierarchical"):
        estimator = feedback(mode, max_iterations=20, linear_threshold=1e-10, angular_threshold=1e-10)
        T = measured(estimator, q)
        T[..., 3] += torch.tensor([3e-3, -2e-3, 1e-3, 0.0], dtype=torch.float64)  # something to disagree about
        mask = torch.tensor([True, False, True])
        other = T.clone()
        other[:, 1, :3, :3] = so3.exp(rotation_vectors((20,), torch.float64, generator(0)))
        have, want = estimator(seed, PI, other, angular_mask=mask), estimator(seed, PI, T, angular_mask=mask)
        assert torch.equal(have.q_bar, want.q_bar)
        assert float(have.angular_error[:, 1].max()) == 0.0
        assert mode != "pose" or float(have.linear_error[:, 1].min()) > 1e-5
        assert mode != "pose" or not torch.allclose(estimator(seed, PI, other).q_bar, want.q_bar, atol=1e-2)
        # No orientation at all: position feedback.
        none = estimator(seed, PI, T, angular_mask=torch.zeros(3, dtype=torch.bool))
        position = feedback("position", max_iterations=20, linear_threshold=1e-10)(seed, PI, T)
        torch.testing.assert_close(none.q_bar, position.q_bar, rtol=0, atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_rows_without_a_sensor_keep_their_seed(mode: str) -> None:
    q, seed = problems(4, seed=5)
    estimator = feedback(mode)
    T = measured(estimator, q)
    mask = torch.ones(4, 3, dtype=torch.bool)
    mask[1] = False
    T[2] = torch.nan
    result = estimator(seed, PI, T, mask)
    assert result.status.tolist() == [0, FeedbackStatus.INVALID, FeedbackStatus.INVALID, 0]
    assert torch.equal(result.q_bar[1:3], seed[1:3])
    assert result.iterations[1:3].tolist() == [0, 0]
    # A seed or a parameter that is no number.
    bad = seed.clone()
    bad[0, 4] = torch.nan
    result = estimator(bad, PI, measured(estimator, q))
    assert result.status.tolist() == [FeedbackStatus.INVALID, 0, 0, 0]
    assert torch.equal(bits(result.q_bar[0]), bits(bad[0]))
    lengths = PI.repeat(4, 1)
    lengths[3, 1] = torch.nan
    result = estimator(seed, lengths, measured(estimator, q))
    assert result.status.tolist() == [0, 0, 0, FeedbackStatus.INVALID]
    assert torch.equal(result.q_bar[3], seed[3])


@pytest.mark.parametrize("mode", MODES)
def test_rows_are_frozen_one_by_one(mode: str) -> None:
    # Easy rows among easy ones, and among rows that need every iteration: not a bit may change.
    q, seed = problems(8, seed=6, off=0.02)
    estimator = feedback(mode, max_iterations=12)
    T = measured(estimator, q)
    easy = estimator(seed, PI, T)
    hard_q, _ = problems(8, seed=7, off=0.3)
    mixed_T, mixed_seed = T.clone(), seed.clone()
    mixed_T[4:] = measured(estimator, hard_q)[4:] @ se3.exp(0.1 * normal((4, 3, 6), torch.float64, generator(0)))
    mixed_seed[4:] = 0.0
    mixed = estimator(mixed_seed, PI, mixed_T)
    assert int(mixed.iterations[4:].max()) > int(easy.iterations.max())
    for have, want in zip(leaves(mixed), leaves(easy), strict=True):
        assert torch.equal(bits(have[:4]), bits(want[:4]))


def test_iterations_and_statuses() -> None:
    q, seed = problems(20, seed=8)
    estimator = feedback("pose", max_iterations=30)
    T = measured(estimator, q)
    exact = estimator(q, PI, T)
    assert (exact.iterations == 1).all() and (exact.status == FeedbackStatus.CONVERGED).all()
    rested = feedback("pose", min_iterations=0)(q, PI, T)
    assert (rested.iterations == 0).all() and (rested.status == FeedbackStatus.CONVERGED).all()
    assert torch.equal(rested.q_bar, q)
    persistent = feedback("pose", min_iterations=4)(seed, PI, T)
    assert (persistent.iterations == 4).all()
    assert float((persistent.q_bar - q).abs().max()) < 1e-6
    single = feedback("pose", max_iterations=1)(seed, PI, T)
    assert (single.iterations == 1).all() and (single.status == FeedbackStatus.ITERATION_LIMIT).any()
    # Sensors that no configuration fits: the rows settle, with a residual.
    _, away = misfit(20, 3, seed=9)
    settled = feedback("position", PI.cumsum(0)[[2]], max_iterations=30)
    assert (settled(seed, PI, T[:, [2]]).status == FeedbackStatus.CONVERGED).all()
    result = estimator(seed, PI, T @ away)
    assert (result.status != FeedbackStatus.CONVERGED).all() and (result.status != FeedbackStatus.INVALID).all()
    assert float(result.linear_error.amax(-1).min()) > 1e-4
    far = feedback("position", max_iterations=100)
    unreachable = T.clone()
    unreachable[..., :3, 3] *= torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)[:, None]
    result = far(seed, PI, unreachable)
    assert torch.isfinite(result.q_bar).all()


@pytest.mark.parametrize("mode", MODES)
def test_never_worse_than_the_seed(mode: str) -> None:
    # Refused steps: whatever the sensors say, the estimate is finite and fits them at least as well as the seed did.
    rng = generator(10)
    estimator = feedback(mode, angular_weight=0.3)
    seed = configurations((200,), 3, torch.float64, rng, bend=3.0, elongation=0.1)
    T = measured(estimator, configurations((200,), 3, torch.float64, rng, bend=3.0, elongation=0.1))
    result = estimator(seed, PI, T)

    def cost(fit: Feedback) -> Tensor:
        position = fit.linear_error.square().sum(-1)
        return position + 0.09 * fit.angular_error.square().sum(-1) if mode == "pose" else position

    blocked = feedback(mode, angular_weight=0.3, max_iterations=1, bend_step=1e-300, length_step=1e-300)
    assert torch.isfinite(result.q_bar).all()
    assert (cost(result) <= cost(blocked(seed, PI, T)) * (1.0 + 1e-2) + 1e-10).all()


def test_angular_weight_trades_position_for_orientation() -> None:
    q, away = misfit(100, 3, seed=11)
    results = []
    for weight in (0.01, 0.1, 1.0):
        estimator = feedback("pose", angular_weight=weight, max_iterations=50)
        results.append(estimator(q, PI, measured(estimator, q) @ away))
    for light, heavy in pairwise(results):
        assert (light.linear_error.norm(dim=-1) < heavy.linear_error.norm(dim=-1)).all()
        assert (light.angular_error.norm(dim=-1) > heavy.angular_error.norm(dim=-1)).all()


def test_hierarchy_puts_positions_first() -> None:
    q, away = misfit(100, 2, seed=12)
    X = PI.cumsum(0)[[0, 2]]
    position, hierarchical = feedback("position", X, max_iterations=50), feedback("hierarchical", X, max_iterations=50)
    T = measured(position, q) @ away
    first, both = position(q, PI, T), hierarchical(q, PI, T)
    # Two sensors leave freedom: positions are met by both, and orientations are better met by the hierarchy.
    assert float(first.linear_error.max()) < 1e-4
    assert (both.linear_error.norm(dim=-1) <= first.linear_error.norm(dim=-1) + 1e-5).all()

    def orientation(q_bar: Tensor) -> Tensor:
        gap = se3.log(se3.inverse(measured(position, q_bar)) @ T)[..., :3]
        return gap.norm(dim=(-1, -2))

    torch.testing.assert_close(both.angular_error.norm(dim=-1), orientation(both.q_bar))
    assert (orientation(both.q_bar) <= orientation(first.q_bar) + 1e-6).all()
    assert float(orientation(both.q_bar).mean()) < 0.9 * float(orientation(first.q_bar).mean())


@pytest.mark.parametrize("weight", [1.0, 0.1])
def test_pose_mode_settles_at_the_least_squares_fit(weight: float) -> None:
    # Sensors that no configuration fits, from two seeds: N = 7 steps reach the point where no direction lowers the
    # weighted residual, whichever way they came. A path-dependent answer would be noise in the velocity.
    q, away = misfit(100, 3, seed=13)
    estimator = feedback("pose", angular_weight=weight)
    T = measured(estimator, q) @ away
    nearby = q + 0.1 * normal((100, 9), torch.float64, generator(0)) * torch.tensor([1, 1, 0.1] * 3).double()

    def cost(q_bar: Tensor) -> Tensor:
        gap = se3.log(se3.inverse(measured(estimator, q_bar)) @ T)
        return gap[..., 3:].square().sum((-1, -2)) + weight**2 * gap[..., :3].square().sum((-1, -2))

    results = [estimator(seed, PI, T) for seed in (q, nearby)]
    for result in results:
        assert int((result.status == FeedbackStatus.SETTLED).sum()) >= 95
        q_bar = result.q_bar.clone().requires_grad_()
        (slope,) = torch.autograd.grad(cost(q_bar).sum(), q_bar)
        assert float(slope.abs().max()) < 1e-6
    torch.testing.assert_close(results[0].q_bar, results[1].q_bar, rtol=0, atol=1e-5)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("sensors", [3, 4])
def test_sensitivity_is_the_implicit_derivative(mode: str, sensors: int) -> None:
    # Inside the arm, so that every sensor slides with the parameters.
    X = torch.tensor({3: [0.1, 0.33, 0.58], 4: [0.1, 0.21, 0.4, 0.58]}[sensors], dtype=torch.float64)
    weight = 0.3
    estimator = feedback(mode, X, angular_weight=weight)
    q = configurations((), 3, torch.float64, generator(14), bend=0.9)
    T = measured(estimator, q)

    def gap(q_bar: Tensor, pi: Tensor) -> Tensor:
        between = se3.inverse(T) @ measured(estimator, q_bar, pi)
        linear, angular = between[:, :3, 3], so3.vee(between[:, :3, :3])
        return (linear if mode != "pose" else torch.cat((linear, weight * angular))).flatten()

    want = -torch.linalg.lstsq(jacfwd(gap)(q, PI), jacfwd(gap, argnums=1)(q, PI)).solution
    have = estimator.sensitivity(q, PI)
    torch.testing.assert_close(have, want, rtol=0, atol=2e-4 * float(want.abs().max()))
    # And the whole algorithm follows its parameters by that slope.
    precise = feedback(mode, X, angular_weight=weight, linear_threshold=1e-15, angular_threshold=1e-15)
    precise.max_iterations, precise.settled_step = 80, 1e-13
    h = 1e-5
    steps = h * torch.eye(3, dtype=torch.float64)
    ahead, behind = (precise(q, PI + sign * steps, T).q_bar for sign in (1.0, -1.0))
    # Where positions overdetermine the arm the hierarchy lets go of 0.1 % of their cost for the orientations' sake.
    rtol = 1e-2 if mode == "hierarchical" and sensors == 4 else 2e-4
    torch.testing.assert_close((ahead - behind).mT / (2 * h), want, rtol=0, atol=rtol * float(want.abs().max()))


def test_sensitivity_of_the_hierarchy_where_positions_leave_freedom() -> None:
    X = PI.cumsum(0)[[0, 2]] - 0.01
    estimator = feedback("hierarchical", X, linear_threshold=1e-15, angular_threshold=1e-15)
    estimator.max_iterations, estimator.settled_step = 80, 1e-13
    q = configurations((), 3, torch.float64, generator(16), bend=0.9)
    T = measured(estimator, q)

    def gap(q_bar: Tensor, pi: Tensor) -> tuple[Tensor, Tensor]:
        between = se3.inverse(T) @ measured(estimator, q_bar, pi)
        return between[:, :3, 3].flatten(), so3.vee(between[:, :3, :3]).flatten()

    (P, A), (P_pi, A_pi) = jacfwd(gap)(q, PI), jacfwd(gap, argnums=1)(q, PI)
    first = -torch.linalg.pinv(P) @ P_pi
    free = torch.linalg.svd(P).Vh[6:].mT
    want = first - free @ torch.linalg.lstsq(A @ free, A_pi + A @ first).solution
    torch.testing.assert_close(estimator.sensitivity(q, PI), want, rtol=0, atol=1e-3 * float(want.abs().max()))
    h = 1e-5
    steps = h * torch.eye(3, dtype=torch.float64)
    ahead, behind = (estimator(q, PI + sign * steps, T).q_bar for sign in (1.0, -1.0))
    torch.testing.assert_close((ahead - behind).mT / (2 * h), want, rtol=0, atol=5e-3 * float(want.abs().max()))


def test_sensitivity_of_masked_sensors() -> None:
    X = torch.tensor([0.1, 0.21, 0.4, 0.58], dtype=torch.float64)
    q = configurations((5,), 3, torch.float64, generator(15), bend=0.9)
    mask = torch.tensor([True, True, False, True])
    for mode in MODES:
        full, fewer = feedback(mode, X), feedback(mode, X[mask])
        want = fewer.sensitivity(q, PI)
        assert torch.isfinite(want).all()
        torch.testing.assert_close(full.sensitivity(q, PI, mask), want, rtol=1e-8, atol=1e-8)
        assert torch.equal(full.sensitivity(q, PI, torch.zeros(4, dtype=torch.bool)), torch.zeros(5, 9, 3).double())
    # Positions alone, by the orientations' mask.
    none = torch.zeros(4, dtype=torch.bool)
    have = feedback("pose", X).sensitivity(q, PI, angular_mask=none)
    torch.testing.assert_close(have, feedback("position", X).sensitivity(q, PI), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_what_follows_an_inference_is_the_sensitivity_at_its_end(mode: str, dtype: torch.dtype) -> None:
    q, seed = problems(5, seed=18)
    estimator = feedback(mode, torch.tensor([0.1, 0.21, 0.4, 0.58], dtype=torch.float64))
    T, mask = measured(estimator, q), torch.tensor([True, True, False, True])
    inference = estimator.infer(seed.to(dtype), PI.to(dtype), T.to(dtype), mask)
    for have, want in zip(inference.feedback, estimator(seed.to(dtype), PI.to(dtype), T.to(dtype), mask), strict=True):
        assert torch.equal(have, want)
    chain, have = estimator.chain_and_sensitivity(inference, torch.Size((2, 5)))
    q_bar = inference.feedback.q_bar
    assert have.dtype == dtype
    torch.testing.assert_close(chain.tip, estimator.backbone.tip(q_bar, PI.to(dtype)).expand(2, 5, 3))
    want = estimator.sensitivity(q_bar, PI.to(dtype), mask, T=T.to(dtype))
    torch.testing.assert_close(*torch.broadcast_tensors(have, want), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("mode", MODES)
def test_sensitivity_in_single_precision(mode: str) -> None:
    q = configurations((50,), 3, torch.float64, generator(17), bend=1.0)
    for sensors in ([0, 1, 2], [0, 2], [2]):  # few sensors leave directions unseen
        estimator = feedback(mode, PI.cumsum(0)[sensors] - 0.01)
        have, want = estimator.sensitivity(q.float(), PI.float()), estimator.sensitivity(q, PI)
        assert have.dtype == torch.float32
        gap = (have - want).norm(dim=(-1, -2)) / want.norm(dim=(-1, -2))
        assert float(gap.max()) < 1e-3, f"{sensors}: {float(gap.max())}"


def test_refusals() -> None:
    backbone = PCCBackbone(3)
    X = PI.cumsum(0)
    for wrong, message in (
        (X[:0], "at least one sensor"),
        (X.flip(0), "increasing"),
        (torch.stack((X[0], X[0])), "increasing"),
        (X - 0.2, "not negative"),
        (torch.tensor([0.1, torch.nan]), "not finite"),
        (torch.tensor([0.1, torch.inf]), "not finite"),
    ):
        with pytest.raises(ValueRangeError, match=f"abscissae.*{message}"):
            StateFeedback(backbone, wrong)
    with pytest.raises(ShapeError, match="abscissae must have shape"):
        StateFeedback(backbone, X[0])
    with pytest.raises(DtypeError, match="abscissae must be a floating-point tensor"):
        StateFeedback(backbone, torch.tensor([1, 2]))
    with pytest.raises(ConfigError, match="mode must be one of position, pose, hierarchical"):
        StateFeedback(backbone, X, "poses")
    for name in ("angular_weight", "max_iterations", "linear_threshold", "angular_threshold", "bend_step", "damping"):
        for value in (0, -1.0, float("nan"), float("inf")):
            with pytest.raises(ApccError, match=f"^{name} must be"):
                StateFeedback(backbone, X, **{name: value})
    with pytest.raises(ValueRangeError, match="min_iterations"):
        StateFeedback(backbone, X, max_iterations=3, min_iterations=4)


def test_refused_measurements() -> None:
    estimator = feedback()
    q, T = torch.zeros(9).double(), torch.eye(4).double().expand(3, 4, 4)
    mask = torch.ones(3, dtype=torch.bool)
    estimator(q, PI, T, mask, mask)
    for arguments, error, message in (
        ((q[:8], PI, T), ShapeError, "q must have shape"),
        ((q, PI[:2], T), ShapeError, "L0 must have shape"),
        ((q, PI, T[:2]), ShapeError, r"T must have shape \(\.\.\., 3, 4, 4\)"),
        ((q, PI, T[..., :3]), ShapeError, "T must have shape"),
        ((q, PI, T.float()), DtypeError, "q_seed is torch.float64 but T is torch.float32"),
        ((q, PI.float(), T), DtypeError, "L0 is torch.float32"),
        ((q, PI, T.long()), DtypeError, "T must be a floating-point tensor"),
        ((q, PI, T, mask[:2]), ShapeError, r"mask must have shape \(\.\.\., 3\), got \(2,\)"),
        ((q, PI, T, mask.long()), DtypeError, "mask must be torch.bool"),
        ((q, PI, T, None, mask[:1]), ShapeError, "angular_mask must have shape"),
        ((q.expand(2, 9), PI, T.expand(5, 3, 4, 4)), ShapeError, "do not broadcast"),
        ((q.expand(2, 9), PI, T, mask.expand(5, 3)), ShapeError, "do not broadcast"),
    ):
        with pytest.raises(error, match=message):
            estimator(*arguments)
