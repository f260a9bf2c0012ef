"""Settings that are a number, or one number a row: checked alike, and each row as if it were alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bank import LengthBank, candidates
from apcc_torch.control.pid import TendonPID
from apcc_torch.control.residual_adaptation import ResidualLaw
from apcc_torch.control.task_integral import TaskIntegral
from apcc_torch.control.trajectory import SineTrajectory
from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.pose_filter import PoseFilter
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.sensor_curve import SensorCurve
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.lie import se3
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.part import hold
from apcc_torch.settings import aligned, check_setting, is_used
from apcc_torch.simulation.sensors import PoseSensors
from arms import HANGING_BASE, PI

ROWS = 3


def rows(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("bad", [-1.0, float("inf"), float("nan")])
def test_a_number_and_a_row_are_refused_alike(bad: float) -> None:
    for value in (bad, rows(1.0, bad)):
        with pytest.raises(ValueRangeError, match="gain must be zero or positive and finite, got"):
            check_setting("gain", value, zero=True)
    with pytest.raises(ValueRangeError, match=r"gain must be positive and finite, got 0\.0"):
        check_setting("gain", rows(1.0, 0.0))
    good = rows(0.0, 2.0)
    assert check_setting("gain", good, zero=True) is good and check_setting("gain", 2.0) == 2.0


def test_held_rows_move_with_their_module_and_numbers_stay_numbers() -> None:
    module = torch.nn.Module()
    hold(module, a=rows(1.0, 2.0), b=3.0, c=None)
    module.to(torch.float32)
    assert module.a.dtype == torch.float32 and dict(module.named_buffers()).keys() == {"a"}
    assert (module.b, module.c) == (3.0, None)


def test_aligned_puts_the_rows_before_what_they_scale() -> None:
    assert aligned(2.0, 2) == 2.0 and aligned(rows(1.0, 2.0), 2).shape == (2, 1, 1)
    assert is_used(rows(0.0, 1.0)) and not is_used(rows(0.0, 0.0)) and is_used(0.5) and not is_used(0.0)


def law(**settings: Any) -> Tensor:
    made = AdaptiveLaw(3, 2.0, **settings)
    e = 0.01 * randn(ROWS, 3)
    return made(PI.expand(ROWS, 3), randn(ROWS, 3, 3, seed=1), e, rows(0.1, 0.1, 0.1))


def solver(**settings: Any) -> Tensor:
    made = InverseKinematics(1.5, **settings)
    return made(randn(ROWS, 3, 9), randn(ROWS, 3, seed=1), randn(ROWS, 3, seed=2), 0.1 * randn(ROWS, 9, seed=3))


def solver_over_a_period(**settings: Any) -> Tensor:
    shape = {"null_gain": 0.5, "null_step": 0.1, "null_bends": rows(0.5, 0.2, -0.1)}
    made = InverseKinematics(1.5, **{**shape, **settings})
    arguments = randn(ROWS, 3, 9), randn(ROWS, 3, seed=1), randn(ROWS, 3, seed=2), 0.1 * randn(ROWS, 9, seed=3)
    return made(*arguments, rows(0.01, 0.02, 0.03))


def pid(**settings: Any) -> Tensor:
    made = TendonPID(**settings)
    z, y, ydot, y_d, ydot_d = (0.01 * randn(ROWS, 4, seed=i) for i in range(5))
    return torch.cat((made(z, y, ydot, y_d, ydot_d), made.integrate(z, y, y_d, 0.1)), dim=-1)


def inferred(**settings: Any) -> Tensor:
    backbone = PCCBackbone(3, HANGING_BASE)
    at = settings.pop("abscissae", rows(0.1, 0.35, 0.6))
    truth = 0.4 * randn(ROWS, 9) * rows(1.0, 1.0, 0.05).repeat(3)
    # Off the model, so that thresholds, weights and step bounds decide where the iteration ends.
    off = se3.exp(settings.pop("misfit", 0.0) * randn(ROWS, 3, 6, seed=1) * rows(1.0, 1.0, 1.0, 0.1, 0.1, 0.1))
    T = backbone.pose(truth, PI * 1.02, *decouple(rows(0.1, 0.35, 0.6), PI)) @ off
    found = StateFeedback(backbone, at, max_iterations=3, **settings)(torch.zeros_like(truth), PI.expand(ROWS, 3), T)
    return torch.cat((found.q_bar, found.angular_error, found.linear_error, found.status.unsqueeze(-1)), dim=-1)


def weighed(**settings: Any) -> Tensor:
    return inferred(misfit=0.1, **settings)


def hierarchical(**settings: Any) -> Tensor:
    return inferred(mode="hierarchical", **settings)


def filtered(**settings: Any) -> Tensor:
    made = SavitzkyGolay(order=2, **settings)
    state = made.initial_state(torch.zeros(ROWS, 2, dtype=torch.float64), torch.zeros(ROWS, dtype=torch.float64))
    for k in range(12):
        state, slope = made(state, randn(ROWS, 2, seed=k), torch.full((ROWS,), 0.01 * (k + 1), dtype=torch.float64))
    return slope


def carried(**settings: Any) -> Tensor:
    backbone, X = PCCBackbone(3, HANGING_BASE), rows(0.1, 0.35, 0.6)
    made, lengths = PoseFilter(**{"angular_time": 0.1, "linear_time": 0.1, **settings}), PI.expand(ROWS, 3)
    q = 0.3 * randn(ROWS, 9) * rows(1.0, 1.0, 0.05).repeat(3)
    seen, dt = torch.ones(ROWS, 3, dtype=torch.bool), rows(0.02, 0.02, 0.02)
    state = made.initial_state(q, 3)
    for k in range(3):
        moved = (1.0 + 0.1 * k) * q
        state, T = made(state, backbone.pose(moved, lengths, *decouple(X, lengths)), seen, seen, dt)
        points = backbone.material_points(lengths, *decouple(X.expand(ROWS, 3), lengths))
        state = made.moved(state, backbone, points, moved, 0.1 * q)
    return T.flatten(-3)


def integrated(**settings: Any) -> Tensor:
    return TaskIntegral(**settings)(1e-3 * randn(ROWS, 3), 1e-3 * randn(ROWS, 3, seed=1), rows(0.1, 0.1, 0.1))


SENSORS = rows(0.105, 0.36, 0.6)


def followed(made: ResidualLaw | LengthBank, steps: int, X: Tensor = SENSORS) -> Tensor:
    """pi_hat after some steps of a law on arms whose first section is shorter than the model's."""
    backbone, feedback = PCCBackbone(3, HANGING_BASE), estimator(X)
    lengths = PI + rows(-0.02, 0.015, 0.0)
    T = backbone.pose(0.5 * randn(ROWS, 9) * rows(1.0, 1.0, 0.02).repeat(3), lengths, *decouple(X, lengths))
    pi, q, seen = PI.expand(ROWS, 3), torch.zeros(ROWS, 9, dtype=torch.float64), torch.ones(ROWS, dtype=torch.bool)
    evidence = made.initial_evidence(q, pi)
    for _ in range(steps):
        q = feedback(q, pi, T).q_bar
        known = feedback.sensitivity(q, pi)
        velocity, evidence = made(backbone, q, pi, known, T, X, rows(0.05, 0.05, 0.05), seen, evidence)  # type: ignore[arg-type]
        pi = pi + 0.05 * velocity
    return pi


def estimator(X: Tensor) -> StateFeedback:
    return StateFeedback(PCCBackbone(3, HANGING_BASE), X, angular_weight=0.1, max_iterations=5)


def curved(abscissae: Tensor = SENSORS, **settings: Any) -> Tensor:
    return followed(ResidualLaw(PI, "curve", SensorCurve(HANGING_BASE, abscissae), **settings), 3, abscissae)


def joint(**settings: Any) -> Tensor:
    return followed(ResidualLaw(PI, "sensors", **{"angular_weight": 0.1, "memory": 1.0, **settings}), 3)


def banked(abscissae: Tensor = SENSORS, **settings: Any) -> Tensor:
    curve = SensorCurve(HANGING_BASE, abscissae, samples=4)
    settings = {"shares": (0.7, 1.0), "stretch": 1.0, "time_constant": 0.1, **settings}
    return followed(LengthBank(PI, estimator(abscissae), curve, **settings), 8, abscissae)


def sensed(**settings: Any) -> Tensor:
    made = PoseSensors(**settings)
    T = torch.eye(4, dtype=torch.float64).expand(ROWS, 2, 4, 4)
    _, seen, mask = made(made.initial_state(T), T, torch.Generator().manual_seed(3))
    return torch.cat((seen.flatten(-2), mask.unsqueeze(-1)), dim=-1)


def sine(omega: Any) -> Tensor:
    target = SineTrajectory(randn(ROWS, 3), randn(ROWS, 3, seed=1), omega)(torch.tensor(0.7, dtype=torch.float64))
    return torch.cat((target.x_d.expand(ROWS, 3), target.xdot_d), dim=-1)


@pytest.mark.parametrize(
    ("make", "name", "values"),
    [
        (law, "rate", (1e-4, 1e-3, 1.0)),
        (law, "normalisation", (0.0, 1.0, 10.0)),
        (law, "dead_zone", (0.0, 1e-3, 1.0)),
        (solver, "damping", (0.0, 1e-2, 1.0)),
        (solver, "null_gain", (0.0, 0.2, 1.0)),
        (solver, "epsilon", (1e-3, 1e-2, 1.0)),
        (solver_over_a_period, "null_step", (0.01, 0.1, 0.5)),
        (solver_over_a_period, "null_speed", (1e-3, 1.0, 9.0)),
        (solver_over_a_period, "epsilon", (1e-3, 1e-2, 1.0)),
        (solver, "bend_rate", (0.01, 0.1, 9.0)),
        (solver, "length_rate", (0.01, 0.1, 9.0)),
        (pid, "K_P", (0.0, 10.0, 750.0)),
        (pid, "K_I", (0.0, 1.0, 5.0)),
        (pid, "K_D", (0.0, 1.0, 5.0)),
        (pid, "force_limit", (0.1, 1.0, 100.0)),
        (pid, "integral_limit", (1e-4, 1e-2, 1.0)),
        (weighed, "angular_weight", (0.1, 0.3, 1.0)),
        (inferred, "linear_threshold", (1e-6, 1e-3, 1.0)),
        (inferred, "angular_threshold", (1e-6, 0.1, 3.0)),
        (inferred, "bend_step", (0.01, 0.2, 2.0)),
        (inferred, "length_step", (1e-4, 1e-3, 0.1)),
        (inferred, "damping", (1e-8, 1e-3, 1.0)),
        (inferred, "settled_step", (1e-9, 0.5, 9.0)),
        (hierarchical, "linear_threshold", (1e-6, 1e-3, 1.0)),
        (filtered, "window", (3, 5, 9)),
        (carried, "angular_time", (0.0, 0.05, 0.5)),
        (carried, "linear_time", (0.0, 0.05, 0.5)),
        (carried, "follow", (0.0, 0.7, 1.0)),
        (integrated, "gain", (0.0, 0.5, 2.0)),
        (integrated, "reach", (1e-4, 1e-3, 1e-2)),
        (curved, "time_constant", (0.1, 0.5, 2.0)),
        (curved, "elongation_weight", (0.0, 0.1, 1.0)),
        (curved, "nominal_weight", (0.0, 0.1, 1.0)),
        (curved, "total_weight", (0.0, 0.1, 1.0)),
        (curved, "damping", (0.01, 0.1, 1.0)),
        (curved, "excitation", (1e-4, 0.1, 1.0)),
        (curved, "rate", (1e-4, 1e-3, 0.1)),
        (joint, "angular_weight", (0.01, 0.1, 1.0)),
        (joint, "memory", (0.01, 0.1, 1.0)),
        (banked, "elongation_weight", (0.0, 0.1, 1.0)),
        (banked, "nominal_weight", (0.0, 0.1, 1.0)),
        (banked, "sharpness", (0.0, 0.3, 3.0)),
        (banked, "resolution", (1e-6, 1e-3, 0.1)),
        (banked, "memory", (0.1, 1.0, 10.0)),
        (banked, "time_constant", (0.1, 0.5, 2.0)),
        (banked, "rate", (1e-3, 1e-2, 0.1)),
        (banked, "stretch", (0.1, 1.0, 2.0)),
        (banked, "total_range", (1e-4, 1e-3, 0.1)),
        (sensed, "position_noise", (1e-3, 1e-2, 1.0)),
        (sensed, "angular_noise", (1e-3, 1e-2, 1.0)),
        (sensed, "dropout", (0.1, 0.5, 0.9)),
        (sine, "omega", (0.1, 1.0, 3.0)),
    ],
)
def test_each_row_is_as_if_its_number_were_every_row_s(
    make: Callable[..., Tensor], name: str, values: tuple[float, ...]
) -> None:
    together = make(**{name: torch.tensor(values) if name == "window" else rows(*values)})
    alone = [make(**{name: value}) for value in values]
    torch.testing.assert_close(together, torch.stack([alone[i][i] for i in range(ROWS)]), rtol=1e-9, atol=1e-12)
    # The setting matters, or the comparison would show nothing.
    assert not torch.allclose(alone[0], alone[2], rtol=1e-6, atol=1e-9)


def test_abscissae_may_differ_from_row_to_row() -> None:
    sets = [rows(0.1, 0.35, 0.6), rows(0.12, 0.3, 0.58), rows(0.05, 0.2, 0.4)]
    together = inferred(abscissae=torch.stack(sets))
    alone = torch.stack([inferred(abscissae=at)[i] for i, at in enumerate(sets)])
    torch.testing.assert_close(together, alone, rtol=1e-9, atol=1e-12)
    for laws in (curved, banked):
        together = laws(abscissae=torch.stack(sets))
        alone = torch.stack([laws(abscissae=at)[i] for i, at in enumerate(sets)])
        torch.testing.assert_close(together, alone, rtol=1e-9, atol=1e-12)


def test_what_the_null_space_prefers_may_differ_from_row_to_row() -> None:
    for name in ("null_weights", "null_bends"):
        sets = [rows(1.0, 0.5, 2.0), rows(0.1, 3.0, 0.0), rows(0.0, 0.2, 0.4)]
        together = solver(null_gain=1.0, **{name: torch.stack(sets)})
        alone = [solver(null_gain=1.0, **{name: each}) for each in sets]
        torch.testing.assert_close(together, torch.stack([alone[i][i] for i in range(ROWS)]), rtol=1e-9, atol=1e-12)
        assert not torch.allclose(alone[0], alone[1], rtol=1e-6, atol=1e-9)


def test_what_a_bank_tries_may_differ_from_row_to_row() -> None:
    sets = [((0.7, 1.0), (0.8, 1.0)), ((0.6, 0.9), (1.0, 1.1)), ((0.8, 1.0), (0.9, 1.2))]
    together = banked(shares=[torch.stack([rows(*each[i]) for each in sets]) for i in range(2)])
    alone = [banked(shares=each) for each in sets]
    assert not torch.allclose(alone[0], alone[1], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(together[1:], torch.stack([alone[i][i] for i in (1, 2)]), rtol=1e-9, atol=1e-12)
    # The first row's nominal lengths are one combination of its own shares, and alone they are not tried twice.
    again = candidates(PI, [torch.stack([rows(*each[i]) for each in sets]) for i in range(2)], SENSORS)
    assert again.shape == (3, 5, 3) and torch.equal(again[0, 0], again[0, -1])


def test_reach_may_differ_from_row_to_row() -> None:
    ends = torch.stack((rows(0.0, 0.0, 0.7), rows(0.2, 0.5, 0.6), rows(0.0, 0.45, 0.5)))
    together = AdaptiveLaw(3, 2.0, reach=ends).project(PI.expand(ROWS, 3))
    alone = torch.stack([AdaptiveLaw(3, 2.0, reach=end).project(PI) for end in ends])
    torch.testing.assert_close(together, alone)
    with pytest.raises(ValueRangeError, match="reach"):
        AdaptiveLaw(3, 2.0, reach=torch.stack((ends[0], rows(0.5, 0.4, 0.6))))


def test_draws_are_shared_where_runs_stand_side_by_side() -> None:
    T = torch.eye(4, dtype=torch.float64).expand(2, ROWS, 2, 4, 4)
    made = PoseSensors(rows(1e-3, 1e-2).unsqueeze(-1), 0.0, 0, 0.3, shared=1)
    _, seen, mask = made(made.initial_state(T), T, torch.Generator().manual_seed(5))
    single = PoseSensors(1e-3, 0.0, 0, 0.3)
    _, one, one_mask = single(single.initial_state(T[0]), T[0], torch.Generator().manual_seed(5))
    torch.testing.assert_close(seen[0], one)
    torch.testing.assert_close(seen[1] - T[1], 10.0 * (seen[0] - T[0]))
    assert torch.equal(mask[0], one_mask) and torch.equal(mask[1], one_mask)


def test_a_window_a_row_is_refused_with_a_period() -> None:
    with pytest.raises(ValueRangeError, match="period must be None"):
        SavitzkyGolay(torch.tensor([3, 5]), 2, period=0.01)
    with pytest.raises(ValueRangeError, match="window must be at least"):
        SavitzkyGolay(torch.tensor([2, 5]), 2)
