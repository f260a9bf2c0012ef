"""The residual laws against finite differences through algorithm 2, on arms at rest, and their own definitions."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.length_law import LengthLaw
from apcc_torch.control.residual_adaptation import Evidence, ResidualLaw
from apcc_torch.control.step_io import Measurement, Target
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, PI, PI_HAT, configurations
from law_steps import law_step
from laws import bits, generator, seeds

BACKBONE = PCCBackbone(3, HANGING_BASE)
SENSORS = torch.tensor([0.105, 0.36, 0.6], dtype=torch.float64)
# Bends that differ from section to section, so that where sections end matters.
BENT = torch.tensor([0.5, -0.2, 0.01, -0.7, 0.4, 0.01, 0.6, 0.5, -0.005], dtype=torch.float64)
DT = torch.tensor(0.02, dtype=torch.float64)


def estimator(mode: str = "pose", **settings: float) -> StateFeedback:
    settings = {"angular_weight": 0.1, "max_iterations": 30, "settled_step": 1e-12, **settings}
    return StateFeedback(BACKBONE, SENSORS, mode, **settings)


def measured(q: Tensor, pi: Tensor = PI) -> Tensor:
    return BACKBONE.pose(q, pi, *decouple(SENSORS, pi))


def law(target: str = "curve", **settings: object) -> ResidualLaw:
    """A quick one, with priors; its curve through the sensors' measured axes."""
    quick = {"time_constant": 0.3, "elongation_weight": 0.05, "nominal_weight": 0.02, "tangents": "measured"}
    return ResidualLaw(PI_HAT, estimator(), target=target, **{**quick, **settings})


PLAIN = {"elongation_weight": 0.0, "nominal_weight": 0.0}


def stepped(
    tried: ResidualLaw, feedback: StateFeedback, pi: Tensor, T: Tensor, evidence: Evidence | None = None
) -> tuple[Tensor, Evidence | None]:
    """The law's velocity and evidence at parameters pi (..., 3)."""
    q = feedback(torch.zeros(*pi.shape[:-1], 9, dtype=pi.dtype), pi, T).q_bar
    return tried.speed(law_step(feedback, q, pi, T, DT), evidence)


@pytest.mark.parametrize(("target", "mode"), [("curve", "position"), ("sensors", "pose")])
@given(seed=seeds)
def test_the_derivative_is_the_total_one(target: str, mode: str, seed: int) -> None:
    # Through algorithm 2 itself, run to its fixed point, on an arm whose poses the model does not meet. No sensor lies
    # where a section ends: there each side has its own derivative.
    rng, pi = generator(seed), PI_HAT
    T = measured(configurations((), 3, torch.float64, rng, bend=0.6, elongation=0.005), PI)
    tried = law(target, angular_weight=0.1 if target == "sensors" else 0.0)
    feedback = estimator(mode, linear_threshold=1e-12, angular_threshold=1e-12)
    seed_q = feedback(torch.zeros(9, dtype=torch.float64), pi, T).q_bar

    def residual(pi: Tensor) -> Tensor:
        q = feedback(seed_q, pi, T).q_bar
        return tried.residual(law_step(feedback, q, pi, T, DT)).value

    A = tried.residual(law_step(feedback, seed_q, pi, T, DT)).derivative
    h = 1e-5
    slopes = [(residual(pi + h * unit) - residual(pi - h * unit)) / (2.0 * h) for unit in torch.eye(3).double()]
    # The distance across the backbone is measured in axes that turn with the model: where it is not zero that adds
    # what the law leaves out, as Gauss-Newton leaves out second derivatives.
    left_out = 4.0 * float(residual(pi).abs().max()) + 5e-4
    torch.testing.assert_close(-torch.stack(slopes, dim=-1), A, atol=left_out, rtol=1e-2)


@pytest.mark.parametrize("settings", [{}, {"memory": 0.5}])
@pytest.mark.parametrize(("target", "mode"), [("curve", "pose"), ("curve", "position"), ("sensors", "pose")])
def test_on_an_arm_at_rest_the_lengths_are_found(target: str, mode: str, settings: dict[str, float]) -> None:
    T, pi = measured(BENT), 0.97 * PI
    weight = 0.1 if target == "sensors" else 0.0
    tried, feedback = law(target, angular_weight=weight, damping=0.005, **PLAIN, **settings), estimator(mode)
    evidence = tried.initial_memory(torch.zeros(9).double(), pi)
    for _ in range(300):
        velocity, evidence = stepped(tried, feedback, pi, T, evidence)
        pi = pi + DT * velocity
    # From one pose of the arm, and through a curve that is not quite an arc. Where the last section ends, beyond or at
    # the last sensor, no sensor tells.
    assert (pi - PI)[:2].abs().max() < (1e-3 if target == "curve" else 5e-4)
    assert (pi - PI)[2].abs() < 0.035 * PI[2]


def test_a_straight_arm_says_nothing() -> None:
    T = measured(torch.zeros(9, dtype=torch.float64))
    velocity, _ = stepped(law(excitation=0.01, **PLAIN), estimator(), PI_HAT, T)
    assert velocity.abs().max() < 1e-9


def test_priors_pull_where_data_are_silent() -> None:
    T, pi = measured(torch.zeros(9, dtype=torch.float64)), torch.tensor([0.1, 0.3, 0.3], dtype=torch.float64)
    silent = {"excitation": 10.0, "elongation_weight": 0.0, "damping": 1e-3, "rate": 10.0, "time_constant": 1.0}
    nominal, _ = stepped(law(nominal_weight=1.0, **silent), estimator(), pi, T)
    torch.testing.assert_close(nominal, PI_HAT - pi, rtol=1e-2, atol=1e-3)
    total, _ = stepped(law(nominal_weight=0.0, total_weight=10.0, **silent), estimator(), pi, T)
    torch.testing.assert_close(total, ((PI_HAT - pi).sum() / 3).expand(3), rtol=1e-2, atol=1e-3)


def test_memory_is_a_forgetting_sum() -> None:
    # With no gain nothing moves, and the evidence is the exponentially weighted mean of what each sample said.
    tried, feedback = law(memory=0.3, gains=torch.zeros(3).double()), estimator()
    evidence = tried.initial_memory(torch.zeros(9).double(), PI_HAT)
    assert evidence is not None
    keep, information, gradient = torch.exp(-DT / 0.3), torch.zeros(3, 3).double(), torch.zeros(3).double()
    for k in range(5):
        T = measured(BENT * (1.0 - 0.1 * k))
        velocity, evidence = stepped(tried, feedback, PI_HAT, T, evidence)
        assert evidence is not None and not bool(velocity.any())
        q = feedback(torch.zeros(9).double(), PI_HAT, T).q_bar
        r, A = tried.residual(law_step(feedback, q, PI_HAT, T, DT))
        information = keep * information + (1 - keep) * A.mT @ A / r.shape[-1]
        gradient = keep * gradient + (1 - keep) * A.mT @ r / r.shape[-1]
    torch.testing.assert_close(evidence.information, information)
    torch.testing.assert_close(evidence.gradient, gradient)


def test_bounds_and_gains() -> None:
    T = measured(BENT)
    plain, _ = stepped(law(rate=1e3), estimator(), PI_HAT, T)
    slow, _ = stepped(law(rate=1e-3), estimator(), PI_HAT, T)
    torch.testing.assert_close(slow, plain * 1e-3 / plain.abs().max())
    one, _ = stepped(law(rate=1e3, gains=torch.tensor([0.0, 1.0, 2.0]).double()), estimator(), PI_HAT, T)
    torch.testing.assert_close(one, plain * torch.tensor([0.0, 1.0, 2.0]).double())


def test_a_bad_row_stays_alone_and_keeps_its_lengths() -> None:
    T, pi = measured(BENT).repeat(4, 1, 1, 1), PI_HAT.repeat(4, 1)
    good, _ = stepped(law(), estimator(), pi, T)
    bad = T.clone()
    bad[1, 2] = torch.nan
    velocity, _ = stepped(law(), estimator(), pi, bad)
    assert torch.equal(bits(velocity[[0, 2, 3]]), bits(good[[0, 2, 3]]))
    assert not bool(velocity[1].any())
    torch.testing.assert_close(stepped(law(), estimator(), PI_HAT, measured(BENT))[0], good[0])


@pytest.mark.parametrize("memory", [0.0, 0.2])
def test_in_the_controller_it_joins_the_law_of_the_task_error(memory: float) -> None:
    def controller(*laws: LengthLaw) -> APCCController:
        bounds = LengthBounds(PI_HAT, reach="free", lower=None, upper=1.0)
        parts = SavitzkyGolay(5, 2), InverseKinematics(1.0, null_gain=0.05), laws
        return APCCController(BACKBONE, estimator(), *parts, bounds=bounds)

    T = measured(BENT)
    target = Target(torch.tensor([0.1, 0.1, -0.5]).double(), torch.zeros(3).double())

    def changed(tried: APCCController) -> tuple[Tensor, Evidence | None]:
        state = tried.initial_state(BENT, PI_HAT)
        state, _ = tried(state, Measurement(T, DT), target)
        return state.pi_hat - PI_HAT, state.memories[-1] if state.memories else None

    both, evidence = changed(controller(AdaptiveLaw(3, 1.0), law(memory=memory)))
    alone, _ = changed(controller(law(memory=memory)))
    assert (evidence is not None) == (memory > 0.0)
    assert float(alone.abs().max()) > 1e-4
    assert float(both.amax()) <= 0.0  # the bounds hold for the sum
    nothing, _ = changed(controller())
    assert not bool(nothing.any())
    # On its own, the speed that the law had alone, as far as the bounds let it.
    q = estimator()(BENT, PI_HAT, T).q_bar
    fresh = law(memory=memory)
    own, _ = fresh.speed(law_step(estimator(), q, PI_HAT, T, DT), fresh.initial_memory(q, PI_HAT))
    torch.testing.assert_close(alone, (DT * own).clamp(max=0.0), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"target": "both"}, ConfigError, "target must be one of"),
        ({"tangents": "straight"}, ConfigError, "tangents must be one of measured, spline"),
        ({"time_constant": 0.0}, ValueRangeError, "time_constant must be positive"),
        ({"damping": -1.0}, ValueRangeError, "damping must be positive"),
        ({"elongation_weight": -1.0}, ValueRangeError, "elongation_weight must be zero or positive"),
        ({"memory": float("nan")}, ValueRangeError, "memory must be zero or positive"),
        ({"gains": torch.tensor([1.0, -1.0, 0.0]).double()}, ValueRangeError, "gains must be zero or positive"),
        ({"gains": [1.0, 2.0]}, ConfigError, "gains must have 3 entries, got 2"),
        ({"samples": 0}, ValueRangeError, "samples must be in"),
    ],
)
def test_bad_settings(settings: dict[str, object], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ResidualLaw(PI_HAT, estimator(), **settings)


def test_the_curve_s_tangents_are_those_that_algorithm_2_uses() -> None:
    for mode, tangents in (("pose", "measured"), ("position", "spline"), ("hierarchical", "measured")):
        curve = ResidualLaw(PI_HAT, estimator(mode)).curve
        assert curve is not None and curve.tangents == tangents
    assert ResidualLaw(PI_HAT, estimator(), target="sensors").curve is None
