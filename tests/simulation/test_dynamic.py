"""The closed loop of section V-B: against scipy's Radau, at rest, in batches, with rows that diverge, and refusals."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.controller import APCCController
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.control.pid import TendonPID, ramp
from apcc_torch.control.trajectory import SetPoint
from apcc_torch.errors import ApccError, ConfigError, ValueRangeError
from apcc_torch.estimation.savitzky_golay import SavitzkyGolay
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics import SoftArmDynamics
from apcc_torch.model.friction import TendonTransmission
from apcc_torch.model.integrators import ArmState
from apcc_torch.model.statics import equilibrium
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import TendonRouting, rack_routing
from apcc_torch.simulation.dynamic import DynamicLog, DynamicSettings, simulate_dynamic
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.sensors import PoseSensors
from arms import HANGING_BASE, PI
from laws import bits, generator

D = torch.float64
RACKS = PI.cumsum(0)
SIX = torch.tensor([0.0525, 0.0525, 0.1275, 0.1275, 0.12, 0.12], dtype=D)
TARGETS = torch.tensor([[0.215, 0.03, -0.515], [-0.075, 0.105, -0.565], [0.13, 0.2, -0.5]], dtype=D)
PAYLOADS = torch.tensor([0.0, 0.5, 0.25], dtype=D)
SHORT = DynamicSettings(duration=0.2, control_rate=50.0)


def dynamics(lengths: Tensor = SIX) -> SoftArmDynamics:
    """The arm of section V-B, one kilogram."""
    axial, bending = scaled_stiffness(lengths)
    return SoftArmDynamics(lengths, lengths / lengths.sum(), axial, bending, 0.1, base_rotation=HANGING_BASE)


def routing() -> TendonRouting:
    return rack_routing(RACKS)


def plant(payload: Tensor, lengths: Tensor = SIX, pid: TendonPID | None = None, **settings: Any) -> Plant:
    settings = {"tendon_damping": 50.0, "substeps": 4, "settle": 0.3, **settings}
    return Plant(dynamics(lengths), routing(), pid, payload, **settings)


def controller(K: float | Tensor = 1.8, tendons: bool = True, adaptive: bool = True) -> APCCController:
    backbone = PCCBackbone(3, HANGING_BASE)
    return APCCController(
        backbone,
        StateFeedback(backbone, RACKS, "pose", angular_weight=0.1),
        SavitzkyGolay(window=7, order=2),
        InverseKinematics(K, null_gain=0.05),
        AdaptiveLaw(3, 0.5, rate=0.1),
        bounds=LengthBounds(PI, lower=0.75, upper=1.25, reach="free"),
        routing=routing() if tendons else None,
        adaptive=adaptive,
        bend_bound=3.0,
        elongation_bound=0.3,
    )


def loop(
    arm: Plant,
    targets: Tensor,
    settings: DynamicSettings = SHORT,
    K: float | Tensor = 1.8,
    sensors: PoseSensors | None = None,
    seed: int = 0,
    pi_hat: Tensor = PI,
) -> DynamicLog:
    with torch.inference_mode():
        seen = PoseSensors() if sensors is None else sensors
        return simulate_dynamic(arm, controller(K), seen, SetPoint(targets), pi_hat, settings, generator(seed))


def tips_by_radau(arm: Plant, y_d: Tensor, start: ArmState, z: Tensor, period: float) -> Tensor:
    """Tips (T, 3) of one arm whose tendon references run straight from each row of y_d (T, n_a) to the next.

    scipy's Radau on the equations of motion and the PID formula; the integrals of the loop are states like any other.
    """
    n, d, B = arm.backbone.n, arm.dynamics, arm.B
    gains = arm.pid

    def slope(k: int) -> Callable[[float, Any], Any]:
        rate = (y_d[k + 1] - y_d[k]) / period

        def field(t: float, x: Any) -> Any:
            q, qdot, integral = torch.from_numpy(np.ascontiguousarray(x.T)).split((n, n, B.shape[-1]), dim=-1)
            error = y_d[k] + (t - k * period) * rate - q @ B
            u = gains.K_P * error + gains.K_I * integral + gains.K_D * (rate - qdot @ B)
            tau = (u - arm.tendon_damping * (qdot @ B)) @ B.mT
            return torch.cat((qdot, d(q, qdot, tau, arm.payload), error), dim=-1).numpy().T

        return field

    x = torch.cat((start.q[0], start.qdot[0], z[0])).numpy()
    # Far below 0.1 mm of tip: 1 um, 0.1 mm/s and their like in rad.
    atol = np.concatenate((np.full(n, 1e-6), np.full(n, 1e-4), np.full(B.shape[-1], 1e-6)))
    tips = [x[:n]]
    for k in range(len(y_d) - 1):
        span = (k * period, (k + 1) * period)
        found = solve_ivp(slope(k), span, x, method="Radau", vectorized=True, rtol=1e-5, atol=atol, first_step=1e-3)
        assert found.success, found.message
        x = found.y[:, -1]
        tips.append(x[:n])
    return arm.backbone.tip(torch.from_numpy(np.stack(tips)), d.lengths)


def test_loop_agrees_with_radau() -> None:
    settings = DynamicSettings(duration=1.0, control_rate=25.0)
    period = 1.0 / settings.control_rate
    # Much tendon damping and a far target: stiff, and with an inertia that changes fast. Plant steps of 5 ms.
    arm = plant(torch.tensor([0.5], dtype=D), tendon_damping=200.0, substeps=8, settle=0.2)
    log = loop(arm, torch.tensor([[0.325, 0.15, -0.275]], dtype=D), settings)
    assert log.diverged_at.tolist() == [-1]
    assert float((log.x[-1] - log.x[0]).norm()) > 0.03, "the arm must move for this to say something"
    with torch.inference_mode():
        start = arm.settled(arm.settle, period / arm.substeps)
        torch.testing.assert_close(log.q_true[0], start.arm.q, rtol=0, atol=0)
        want = tips_by_radau(arm, log.y_d[:, 0], start.arm, start.z, period)
    assert float((log.x[-1, 0] - want[-1]).norm()) < 1e-4
    assert float((log.x[:, 0] - want).norm(dim=-1).max()) < 2e-4


def test_plant_step_is_of_order_two_along_a_ramp() -> None:
    # Two sections and soft tendons, so that the step is in the asymptotic range; integral action strong enough to show.
    lengths = torch.tensor([0.3, 0.3], dtype=D)
    arm = plant(torch.tensor([0.2], dtype=D), lengths, TendonPID(100.0, 200.0, 1.0), tendon_damping=1.0)
    previous, y = 0.01 * torch.sin(torch.arange(18, dtype=D)).view(2, 1, 9)
    period, ends = 0.1, []
    for steps in (16, 32, 64, 320):
        now = arm.straight((1,))
        for i in range(steps):
            now = arm.step(now, ramp(previous, y, (i + 1) / steps, period), period / steps)
        ends.append(torch.cat((*now.arm, now.z), dim=-1))
    errors = [float((end - ends[-1]).norm()) for end in ends[:-1]]
    integrals = [float((end - ends[-1])[:, 12:].norm()) for end in ends[:-1]]
    for coarse, fine in (*pairwise(errors), *pairwise(integrals)):
        assert 3.0 < coarse / fine < 5.5


def test_settled_arm_is_at_rest_where_statics_says() -> None:
    # Without integral action the held tendons are springs of K_P: a compliance of 1 / K_P in the statics.
    pid = TendonPID(750.0, 0.0, 5.0)
    arm = plant(torch.tensor([0.0, 0.5], dtype=D), torch.tensor([0.36, 0.24], dtype=D), pid, tendon_damping=5.0)
    with torch.inference_mode():
        now = arm.settled(4.0, 0.02)
        state = now.arm
        assert now.diverged_at.tolist() == [-1, -1]
        zero = torch.zeros(2, 9, dtype=D)
        u = arm.forces(now, ramp(zero, zero, 1.0, 0.01))
        tau = (arm.B @ u.unsqueeze(-1)).squeeze(-1)
        unbalanced = tau - arm.dynamics.stiffness_diagonal * state.q - arm.dynamics.gravity(state.q, arm.payload)
    assert float(state.qdot.abs().max()) < 1e-8
    assert float(unbalanced.abs().max()) < 1e-6
    want = equilibrium(
        arm.dynamics, routing=routing(), tendon_lengths=zero, compliance=1.0 / pid.K_P, payload=arm.payload
    )
    assert bool(want.converged.all())
    torch.testing.assert_close(state.q, want.q, rtol=0, atol=1e-8)
    torch.testing.assert_close(u, want.u, rtol=0, atol=1e-6)
    # The heavier arm hangs lower.
    height = arm.backbone.tip(state.q, arm.dynamics.lengths)[:, 2]
    assert float(height[1]) < float(height[0]) - 1e-3


def test_run_starts_on_the_settled_arm_as_the_sensors_see_it() -> None:
    arm = plant(PAYLOADS[1:2])
    log = loop(arm, TARGETS[:1])
    with torch.inference_mode():
        start = arm.settled(arm.settle, 1.0 / SHORT.control_rate / arm.substeps).arm
    assert torch.equal(log.q_true[0], start.q)
    torch.testing.assert_close(log.time, torch.arange(11, dtype=D) / SHORT.control_rate)
    # Nothing has been asked for yet: the first command is the model's own shape.
    torch.testing.assert_close(log.q_d[0], log.q_bar[0], rtol=0, atol=1e-4)
    torch.testing.assert_close(log.pi_hat[0], PI.expand(1, 3))
    assert torch.equal(log.x_d, TARGETS[:1].expand(11, 1, 3))
    torch.testing.assert_close(log.x, arm.backbone.tip(log.q_true, SIX))
    torch.testing.assert_close(log.y, log.q_true @ arm.B)


def test_rows_of_a_batch_equal_single_runs() -> None:
    settings = DynamicSettings(duration=0.2, control_rate=25.0)
    together = loop(plant(PAYLOADS, settle=0.1), TARGETS, settings)
    assert together.diverged_at.tolist() == [-1, -1, -1]
    for row in range(3):
        alone = loop(plant(PAYLOADS[row : row + 1], settle=0.1), TARGETS[row : row + 1], settings)
        for name in ("x", "q_true", "q_bar", "q_d", "pi_hat", "y", "y_d"):
            have, want = getattr(together, name)[:, row], getattr(alone, name)[:, 0]
            torch.testing.assert_close(have, want, rtol=0, atol=1e-9, msg=lambda m, name=name: f"{name}: {m}")


def test_an_unstable_row_is_frozen_and_its_neighbours_never_notice() -> None:
    def run(gain: float) -> DynamicLog:
        K = torch.diag_embed(torch.tensor([1.8, gain, 1.8], dtype=D).unsqueeze(-1).expand(3, 3))
        settings = DynamicSettings(duration=0.4, control_rate=50.0)
        return loop(plant(PAYLOADS, settle=0.1, bound=30.0), TARGETS, settings, K)

    calm, wild = run(1.8), run(2e4)
    assert calm.diverged_at.tolist() == [-1, -1, -1]
    at = int(wild.diverged_at[1])
    assert at >= 0 and wild.diverged_at[[0, 2]].tolist() == [-1, -1]
    assert all(bool(field.isfinite().all()) for field in wild if field.is_floating_point())
    assert torch.equal(wild.q_true[at + 1 :, 1], wild.q_true[-1:, 1].expand(len(wild.time) - at - 1, -1)), "frozen"
    for name in DynamicLog._fields[1:-1]:
        was, now = (getattr(log, name)[:, [0, 2]] for log in (calm, wild))
        assert torch.equal(bits(was), bits(now)), name


def test_a_row_that_is_not_finite_leaves_the_others_alone() -> None:
    good = loop(plant(PAYLOADS), TARGETS)
    payload = PAYLOADS.clone()
    payload[1] = torch.nan
    bad = loop(plant(payload), TARGETS)
    assert bad.diverged_at.tolist() == [-1, 0, -1]
    assert bool(bad.q_true.isfinite().all())
    for name in DynamicLog._fields[1:-1]:
        was, now = (getattr(log, name)[:, [0, 2]] for log in (good, bad))
        assert torch.equal(bits(was), bits(now)), name


def test_the_seed_decides_the_run() -> None:
    noisy = PoseSensors(2e-4, 9e-3, delay=1, dropout=0.05)
    settings = DynamicSettings(duration=0.1, control_rate=50.0)
    arm = plant(PAYLOADS, substeps=2, settle=0.05)
    first, again, other = (loop(arm, TARGETS, settings, sensors=noisy, seed=s) for s in (1, 1, 2))
    assert all(torch.equal(bits(a), bits(b)) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first.q_bar, other.q_bar)


def test_progress_counts_control_steps() -> None:
    seen: list[int] = []

    def progress(steps: Any) -> Any:
        for k in steps:
            seen.append(k)
            yield k

    settings, arm = DynamicSettings(duration=0.06, control_rate=50.0), plant(PAYLOADS[:1], substeps=1, settle=0.0)
    with torch.inference_mode():
        target = SetPoint(TARGETS[:1])
        simulate_dynamic(arm, controller(), PoseSensors(), target, PI, settings, progress=progress)
    assert seen == [0, 1, 2, 3]


@pytest.mark.parametrize("name", ["duration", "control_rate", "substeps", "settle"])
@pytest.mark.parametrize("value", [-1, float("nan"), float("inf")])
def test_bad_settings_are_refused(name: str, value: float) -> None:
    settings = PlantSettings if name in ("substeps", "settle") else DynamicSettings
    needed = {} if settings is PlantSettings else {"duration": 10.0, "control_rate": 100.0}
    with pytest.raises(ApccError, match=f"^{name} must be"):
        settings(**{**needed, name: value})


def test_bad_plants_and_controllers_are_refused() -> None:
    for value in (-1.0, float("nan")):
        with pytest.raises(ValueRangeError, match="tendon_damping"):
            plant(PAYLOADS, tendon_damping=value)
    lengths = SIX.expand(2, 6)
    axial, bending = scaled_stiffness(lengths)
    turned = SoftArmDynamics(lengths, lengths, axial, bending, 0.1, base_rotation=HANGING_BASE.expand(2, 3, 3))
    with pytest.raises(ConfigError, match="base_rotation"):
        Plant(turned, routing(), TendonPID(), PAYLOADS[:2])
    with pytest.raises(ConfigError, match="routing"):
        simulate_dynamic(plant(PAYLOADS), controller(tendons=False), PoseSensors(), SetPoint(TARGETS), PI, SHORT)


def test_transmission_is_felt_by_the_arm() -> None:
    """An ideal transmission changes nothing; slack drops pushes; dry friction is felt."""
    payload = torch.zeros(1, dtype=D)

    def moved(transmission: TendonTransmission | None, y: float) -> Tensor:
        arm = Plant(dynamics(), routing(), TendonPID(), payload, 50.0, transmission=transmission)
        y_d = torch.zeros(1, 9, dtype=D)
        y_d[0, 0] = y
        now = arm.straight((1,))
        for _ in range(20):
            now = arm.step(now, ramp(y_d, y_d, 1.0, 0.01), 0.005)
        return now.arm.q

    ideal = TendonTransmission(routing(), friction=0.0, slack=False)
    torch.testing.assert_close(moved(ideal, -0.02), moved(None, -0.02), rtol=1e-12, atol=1e-15)
    # Let out, a slack tendon leaves the arm to gravity and the other tendons, as if it had not been commanded at all.
    loose = TendonTransmission(routing(), slack=True)
    bend = moved(loose, 0.02)[..., 0].abs()
    assert bend < 0.1 * moved(None, 0.02)[..., 0].abs()
    rubbing = TendonTransmission(routing(), friction=1.0, slack=False)
    held, free = moved(rubbing, -0.02)[..., 0], moved(None, -0.02)[..., 0]
    # How the tension falls along the way is held by the tests of the transmission; here only that the arm feels it.
    assert 1e-3 < (held / free - 1).abs() < 0.5
