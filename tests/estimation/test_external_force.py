"""Payload and force from tensions and shape: exact on the model's own equilibria, honest about noise and ignorance."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch import StateFeedback
from apcc_torch.errors import ConfigError, ValueRangeError
from apcc_torch.estimation.external_force import BalanceNoise, ForceBalance, tare
from apcc_torch.estimation.posture import Posture
from apcc_torch.estimation.weighted_estimate import EstimateStatus
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.static_body import StaticBody
from apcc_torch.native.function import NativeFunction
from apcc_torch.simulation.sensors import PoseSensors
from arms import HANGING_BASE, PI
from laws import check_bad_row, check_batching, generator, normal
from resting_arms import MATERIAL, RACKS, ROUTING, Resting, at_rest, balance, posture

D = torch.float64
PAYLOAD = torch.tensor([0.0, 0.1, 0.25, 0.5], dtype=D)
FORCES = torch.tensor([[0.5, 0.0, 0.2], [0.0, -1.0, 0.4], [-0.3, 0.6, -1.0], [0.1, 0.1, 0.05]], dtype=D)


def test_a_payload_is_weighed() -> None:
    found = balance().payload(posture(at_rest(4, PAYLOAD)))
    assert (found.status == EstimateStatus.DETERMINED).all()
    torch.testing.assert_close(found.value[:, 0], PAYLOAD, rtol=1e-6, atol=1e-8)
    assert float(found.misfit.max()) < 1e-9


@pytest.mark.parametrize("section", [0, 1, 2])
def test_a_force_at_a_known_place_is_measured(section: int) -> None:
    p = posture(at_rest(4, PAYLOAD, section=section, force=FORCES))._replace(payload=PAYLOAD)
    X = RACKS[section : section + 1]
    found = balance(limit=50.0).force(p, X)
    torch.testing.assert_close(found.value, FORCES, rtol=1e-5, atol=1e-6)
    if section == 2:
        torch.testing.assert_close(balance(limit=50.0).force(p).value, found.value)


def test_its_deviation_is_the_spread_under_noise() -> None:
    """Sensors and tensions drawn 400 times: errors are as large as stated, and the misfit is a chi-square's."""
    rest = at_rest(1, PAYLOAD[2:3], force=FORCES[:1])
    noise = BalanceNoise(position=3e-4, angle=5e-3, tension=0.1, bend=1e-6, length=1e-6)
    b = balance(noise=noise)
    sensors = PoseSensors(3e-4, 5e-3)
    T = rest.T.expand(400, 3, 4, 4)
    seen = sensors(sensors.initial_state(T), T, generator(8))[1]
    u = rest.u + 0.1 * normal((400, 9), D, generator(9))
    q_bar = b.feedback(rest.q.expand(400, 9), PI, seen).q_bar
    found = b.force(Posture(q_bar, PI.expand(400, 3), u, payload=PAYLOAD[2:3].expand(400)))
    error = found.value - FORCES[:1]
    squared = (error * torch.linalg.solve(found.covariance, error)).sum(-1)
    assert abs(float(squared.mean()) - 3.0) < 0.5
    assert abs(float(found.misfit.mean()) - 6.0) < 0.8


def test_damping_is_taken_out_of_slow_motion() -> None:
    """The force that damping takes at qdot, added to the tendons', changes nothing."""
    rest = at_rest(2, PAYLOAD[:2])
    b = balance(damping_ratio=0.1, tendon_damping=20.0)
    qdot = 0.05 * normal((2, 9), D, generator(4))
    B = ROUTING.matrix(PI)
    stiffness = b.body.stiffness(PI)
    u = rest.u + torch.linalg.solve(B, (0.1 * stiffness * qdot).unsqueeze(-1)).squeeze(-1) + 20.0 * qdot @ B
    found = b.payload(Posture(rest.q, PI.expand(2, 3), u, qdot))
    torch.testing.assert_close(found.value[:, 0], PAYLOAD[:2], rtol=1e-6, atol=1e-7)


def test_without_tensions_constant_curvature_says_so() -> None:
    p = posture(at_rest(4, PAYLOAD))._replace(u=None)
    found = balance().payload(p)
    assert (found.status == EstimateStatus.UNDETERMINED).all() and bool(found.value.isnan().all())


def _bent_by_energy(model: AffineBackbone, u: Tensor, payload: float) -> Tensor:
    """q (15,) that minimises the energy of weight, elasticity, tendons and payload: no balance of forces is used."""
    s = (torch.arange(12, dtype=D) + 0.5) / 12
    X_tilde, j = s.repeat(3), torch.arange(3).repeat_interleave(12)
    B = model.tendon_matrix(ROUTING, PI)
    along = torch.linspace(0.0, 1.0, 41, dtype=D)
    simpson = torch.tensor([1.0, *[4.0, 2.0] * 19, 4.0, 1.0], dtype=D) / 120.0

    def energy(q: Tensor) -> Tensor:
        height = model.pose(q, PI, X_tilde, j)[..., 2, 3]
        weight = 9.81 * (MATERIAL[0] * (PI / 12).repeat_interleave(12) * height).sum()
        parts = q.view(3, 5)
        bend = parts[:, :2, None] + (2.0 * along - 1.0) * parts[:, 2:4, None]
        elastic = 0.5 * (MATERIAL[2] / PI * ((bend**2).sum(1) * simpson).sum(-1) + MATERIAL[1] / PI * parts[:, 4] ** 2)
        return weight + elastic.sum() - u @ (B.mT @ q) + payload * 9.81 * model.tip(q, PI)[2]

    q = torch.zeros(15, dtype=D)
    for _ in range(15):
        slope, curvature = torch.func.grad(energy)(q), torch.func.hessian(energy)(q)
        step = torch.linalg.solve(curvature, slope)
        q = q - step * (0.3 / step.abs().max()).clamp(max=1.0)
    assert float(torch.func.grad(energy)(q).norm()) < 1e-9
    return q


def test_with_slopes_the_shape_alone_weighs_the_payload() -> None:
    model = AffineBackbone(3, HANGING_BASE, rods=2)
    u = torch.tensor([-3.0, -2.0, -4.0, -1.0, -3.0, -5.0, -2.0, -6.0, -2.0], dtype=D)
    q = _bent_by_energy(model, u, 0.3)
    b = balance(model)
    seen = b.payload(Posture(q, PI, u))
    assert abs(float(seen.value) - 0.3) < 1e-4  # the body's mass points are four a section, the energy's twelve
    blind = b.payload(Posture(q, PI, None))
    assert blind.status == EstimateStatus.DETERMINED and abs(float(blind.value) - 0.3) < 1e-3
    assert float(blind.deviation) > float(seen.deviation)


def test_a_tare_takes_out_what_the_unloaded_arm_shows() -> None:
    """A model that is 10 % too soft weighs wrongly; tared on the unloaded arm in the same posture, far less so."""
    stiff = StaticBody(PCCBackbone(3, HANGING_BASE), MATERIAL[0], 0.9 * MATERIAL[1], 0.9 * MATERIAL[2])
    b = ForceBalance(stiff, ROUTING, StateFeedback(PCCBackbone(3, HANGING_BASE), RACKS))
    empty, loaded = posture(at_rest(3)), posture(at_rest(3, torch.full((3,), 0.05, dtype=D)))
    floor = torch.full((9,), 0.02, dtype=D)
    for row in range(3):
        there = tare(b.imbalance(empty)[row : row + 1], floor)
        raw, tared = (b.payload(Posture(*(v[row] for v in loaded[:3])), t).value for t in (None, there))
        assert abs(float(tared) - 0.05) < 0.4 * abs(float(raw) - 0.05)
    many = tare(b.imbalance(empty), floor)
    torch.testing.assert_close(many.offset, b.imbalance(empty).mean(0))
    torch.testing.assert_close(many.covariance, b.imbalance(empty).mT.cov() + torch.diag(floor**2))


def test_leading_dimensions_are_a_batch_and_bad_rows_stay_alone() -> None:
    b = balance()

    def inputs(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
        q = 0.3 * normal((*shape, 9), dtype, rng)
        return q, (PI + 0.01 * normal((*shape, 3), D, rng)).to(dtype), -3.0 + normal((*shape, 9), dtype, rng)

    def op(q: Tensor, pi: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        return tuple(b.force(Posture(q, pi, u)))

    check_batching(op, inputs, shared=(0, 1, 2), scale=1e3)
    check_bad_row(op, inputs((3,), D, generator(3)))
    q, pi, u = inputs((2,), D, generator(3))
    q[0, 0] = torch.nan
    assert b.force(Posture(q, pi, u)).status.tolist() == [EstimateStatus.INVALID, EstimateStatus.DETERMINED]


def test_the_estimate_is_differentiable() -> None:
    rest: Resting = at_rest(1, PAYLOAD[2:3])
    b = balance()
    p = posture(rest)
    S = b.covariance(p)

    def mass(q: Tensor, u: Tensor) -> Tensor:
        return b.payload(Posture(q, PI.expand(1, 3), u), covariance=S).value

    q, u = (v.clone().requires_grad_() for v in (rest.q, rest.u))
    assert torch.autograd.gradcheck(mass, (q, u), atol=1e-5)


class _Weighing(torch.nn.Module):
    """One step of a loop that weighs, its weights known."""

    def __init__(self) -> None:
        super().__init__()
        self.balance = balance()

    def forward(self, q: Tensor, pi: Tensor, u: Tensor, S: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.balance.payload(Posture(q, pi, u), covariance=S))


def test_it_runs_as_machine_code() -> None:
    step = _Weighing()
    p = posture(at_rest(3, PAYLOAD[1:]))
    S = step.balance.covariance(p)
    rows = (p.q_bar, p.pi_hat, p.u, S)
    with torch.no_grad():
        native = NativeFunction(step, tuple(v[0] for v in rows if v is not None))
        for have, want in zip(native(*rows), step(*rows), strict=True):
            torch.testing.assert_close(have, want, rtol=1e-8, atol=1e-10)


def test_bad_settings_are_named() -> None:
    body, feedback = (
        StaticBody(AffineBackbone(3, HANGING_BASE), *MATERIAL),
        StateFeedback(PCCBackbone(3, HANGING_BASE), RACKS),
    )
    with pytest.raises(ConfigError, match="same kinematic model"):
        ForceBalance(body, ROUTING, feedback)
    with pytest.raises(ValueRangeError, match=r"noise\.bend"):
        balance(noise=BalanceNoise(bend=0.0))
    with pytest.raises(ValueRangeError, match="limit"):
        balance(limit=0.0)
