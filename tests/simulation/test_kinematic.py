"""The loop of section V-A: Lyapunov's function falls as proved, and the whole loop does what it should at first."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import pytest
import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.trajectory import SineTrajectory
from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.feedback import FeedbackStatus
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.simulation.exact import simulate_exact
from apcc_torch.simulation.kinematic import simulate_feedback, start_configuration
from apcc_torch.simulation.metrics import backbone_error
from arms import HANGING_BASE, PI, PI_HAT
from laws import generator, uniform

GAMMA = torch.tensor([90.0, 42.5, 35.0], dtype=torch.float64)
R_0 = torch.tensor([0.0, 0.0, -0.5], dtype=torch.float64)
AMPLITUDE = torch.tensor([0.5, 0.3, 0.1], dtype=torch.float64)
OMEGA = 0.2 * math.pi


def controller(
    gamma: Tensor = GAMMA,
    mode: str = "pose",
    damping: float = 1e-6,
    K: float | Tensor = 1.0,
    adaptive: bool = True,
    regressor: str = "estimator_aware",
) -> APCCController:
    backbone = PCCBackbone(3, HANGING_BASE)
    return APCCController(
        backbone,
        StateFeedback(backbone, PI.cumsum(0), mode),
        SavitzkyGolay(window=5, order=2),
        InverseKinematics(K=K, damping=damping, null_gain=1.0),
        AdaptiveLaw(3, gamma, regressor),
        # The farthest sensor is at the tip: the arm is no shorter than that.
        bounds=LengthBounds(PI, PI.cumsum(0), lower=None, upper=None, reach="last"),
        adaptive=adaptive,
    )


def trajectory() -> SineTrajectory:
    return SineTrajectory(R_0, AMPLITUDE, OMEGA)


def test_lyapunov_function_falls_as_proved() -> None:
    # V = e^T e / 2 + pi_tilde^T Gamma^-1 pi_tilde / 2 of Eq. (18) has Vdot = -e^T K e, whatever pi_hat is. The paper's
    # K, and another in a second row.
    K = torch.tensor([[1.0, 1.0, 1.0], [0.5, 1.0, 2.0]], dtype=torch.float64)
    rate, duration = 100.0, 2.0
    c = controller(damping=0.0, K=torch.diag_embed(K))
    log = simulate_exact(c, PI, PI_HAT.expand(2, 3), trajectory(), duration, rate)
    e, error = log.x_d - log.x, PI - log.pi_hat
    V = 0.5 * e.square().sum(-1) + 0.5 * (error.square() / GAMMA).sum(-1)
    loss = (e * K * e).sum(-1)
    # Five-point central difference, of the fourth order in the step as the integrator is.
    Vdot = (V[:-4] - 8.0 * V[1:-3] + 8.0 * V[3:-1] - V[4:]) * rate / 12.0
    scale = float(loss.amax(0).min())
    assert scale > 1e-5  # it is a motion with an error, not a rest
    torch.testing.assert_close(Vdot, -loss[2:-2], rtol=0, atol=1e-4 * scale)
    # The same without a difference quotient: Simpson's rule over the whole time.
    weights = torch.full_like(loss, 2.0)
    weights[1::2], weights[0], weights[-1] = 4.0, 1.0, 1.0
    lost = (weights * loss).sum(0) / (3.0 * rate)
    torch.testing.assert_close(V[0] - V[-1], lost, rtol=1e-5, atol=0)
    assert float(V.diff(dim=0).max()) < 1e-12
    assert float((log.pi_hat[-1] - log.pi_hat[0]).abs().max()) > 1e-4


def test_exact_loop_without_adaptation_keeps_its_parameters() -> None:
    log = simulate_exact(controller(adaptive=False), PI, PI_HAT, trajectory(), 0.1, 50.0)
    assert torch.equal(log.pi_hat, PI_HAT.expand(6, 3))
    assert log.time.tolist() == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08, 0.1])
    # With the true parameters there is no error to begin with, and none comes.
    log = simulate_exact(controller(adaptive=False, damping=0.0), PI, PI, trajectory(), 0.5, 50.0)
    assert float((log.x_d - log.x).norm(dim=-1).max()) < 1e-7


def test_start_configuration() -> None:
    backbone = PCCBackbone(3, HANGING_BASE)
    x = R_0 + uniform((20, 3), -0.15, 0.15, torch.float64, generator(0))
    q = start_configuration(backbone, PI, x)
    assert float((backbone.tip(q, PI) - x).norm(dim=-1).max()) < 1e-6
    single = start_configuration(backbone, PI.float(), R_0.float())
    assert single.dtype == torch.float32
    with pytest.raises(ValueRangeError, match="out of reach"):
        start_configuration(backbone, PI, x, iterations=1)


@pytest.mark.parametrize("mode", ["position", "pose"])
def test_true_parameters_are_a_fixed_point_of_the_whole_loop(mode: str) -> None:
    # Nothing to learn: algorithm 2 fits the sensors, the tip follows, and the law leaves the parameters.
    log = simulate_feedback(controller(0.2 * GAMMA, mode), PI, PI, trajectory(), 1.0, 100.0)
    assert not (log.status == FeedbackStatus.INVALID).any()
    assert float(log.linear_error.max()) < 2e-3
    e = (log.x_d - log.x).norm(dim=-1)
    # What is left is the arm's holding each velocity for a period, which the tip error sees and the law answers.
    assert float(e.max()) < 5e-3
    assert float((log.pi_hat - PI).abs().max()) < 5e-3


@pytest.mark.parametrize("mode", ["position", "pose"])
def test_whole_loop_learns(mode: str) -> None:
    # A fifth of the paper's gain, the first seconds, three guesses of the parameters in one batch.
    guesses = torch.stack((PI_HAT, PI + 0.3 * (PI_HAT - PI), PI - 0.3 * (PI_HAT - PI)))
    c = controller(0.2 * GAMMA, mode)
    log = simulate_feedback(c, PI, guesses, trajectory(), 3.0, 50.0)
    assert log.x.shape == (151, 3, 3) and log.linear_error.shape == (151, 3, 3)
    for field in log:
        assert torch.isfinite(field).all()
    assert not (log.status == FeedbackStatus.INVALID).any()
    assert torch.equal(log.pi_hat[0], guesses)
    # The error is that of the true tip, and the true arm is where the log says.
    torch.testing.assert_close(log.x, c.backbone.tip(log.q_true, PI), rtol=0, atol=1e-12)
    e = (log.x_d - log.x).norm(dim=-1)
    assert float(e[0].max()) < 1e-6
    shape = backbone_error(c.backbone, log.q_true[[0, -1]], PI, c.backbone, log.q_bar[[0, -1]], log.pi_hat[[0, -1]])
    assert float(e.max()) < 0.02 and float(e[-1].max()) < 3e-3
    assert float(shape[0, 0]) > 0.025 and float(shape[-1].max()) < 0.01
    assert float(shape[-1, 0]) < 0.2 * float(shape[0, 0])
    # Too short an arm is put right at once: the last sensor says how far it reaches.
    assert float(log.pi_hat[1:].sum(-1).min()) > float(PI.sum()) - 1e-9


def test_rows_run_alone() -> None:
    c = controller(0.2 * GAMMA)
    guesses = torch.stack((PI_HAT, PI))
    both = simulate_feedback(c, PI, guesses, trajectory(), 0.2, 50.0)
    seen: list[int] = []

    def progress(steps: Iterable[int]) -> Iterator[int]:
        for k in steps:
            seen.append(k)
            yield k

    alone = simulate_feedback(c, PI, PI, trajectory(), 0.2, 50.0, progress)
    assert seen == list(range(11))
    torch.testing.assert_close(both.q_bar[:, 1], alone.q_bar, rtol=0, atol=1e-9)
    torch.testing.assert_close(both.pi_hat[:, 1], alone.pi_hat, rtol=0, atol=1e-9)
