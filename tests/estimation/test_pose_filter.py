"""The pose filter against a moving arm, against noise, across gaps, and in another frame."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ValueRangeError
from apcc_torch.estimation.pose_filter import PoseFilter, PoseFilterState
from apcc_torch.lie import se3, so3
from apcc_torch.model.abscissae import MaterialPoints, decouple
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, PI, configurations
from laws import FLOATS, generator, normal

BACKBONE = PCCBackbone(3, HANGING_BASE)
SENSORS = PI.cumsum(0)
DT = torch.tensor(0.02, dtype=torch.float64)


def seen(rows: int = 2, k: int = 3) -> Tensor:
    return torch.ones(rows, k, dtype=torch.bool)


def poses(q: Tensor) -> Tensor:
    return BACKBONE.pose(q, PI, *decouple(SENSORS, PI))


def points(rows: int = 2) -> MaterialPoints:
    lengths = PI.expand(rows, 3)
    return BACKBONE.material_points(lengths, *decouple(SENSORS.expand(rows, 3), lengths))


def angle(A: Tensor, B: Tensor) -> Tensor:
    return so3.log(A[..., :3, :3].mT @ B[..., :3, :3]).norm(dim=-1)


def noisy(T: Tensor, spread: float, rng: torch.Generator) -> Tensor:
    turn = spread * normal((*T.shape[:-2], 3), T.dtype, rng)
    return T @ se3.exp(torch.cat((turn, torch.zeros_like(turn)), dim=-1))


def scene(rows: int = 2, seed: int = 0) -> Tensor:
    return configurations((rows,), 3, torch.float64, generator(seed), bend=0.8)


def test_the_first_reading_is_taken_as_it_is() -> None:
    q = scene()
    poses_filter = PoseFilter(0.3, 0.2)
    state, T = poses_filter(poses_filter.initial_state(q, 3), poses(q), seen(), seen(), DT)
    torch.testing.assert_close(T, poses(q), rtol=0, atol=1e-15)
    assert torch.equal(state.age, torch.zeros(2, 3, 2, dtype=torch.float64))


@pytest.mark.parametrize("dtype", FLOATS)
def test_without_time_constants_nothing_is_changed(dtype: torch.dtype) -> None:
    rng = generator(1)
    q = scene().to(dtype)
    poses_filter = PoseFilter(0.0, 0.0)
    state = poses_filter.initial_state(q, 3)
    for _ in range(3):
        T = noisy(poses(q.double()), 0.02, rng).to(dtype)
        state, filtered = poses_filter(state, T, seen(), seen(), DT.to(dtype))
        assert torch.equal(filtered, T)
        assert filtered.dtype == dtype


def test_an_arm_that_follows_its_command_is_followed_without_lag() -> None:
    q, rate = scene(), 0.5 * normal((2, 9), torch.float64, generator(2))
    rate[:, 2::3] *= 0.1
    following, late = PoseFilter(0.5, 0.5, follow=1.0), PoseFilter(0.5, 0.5, follow=0.0)
    states = [following.initial_state(q, 3), late.initial_state(q, 3)]
    errors = []
    for _ in range(50):
        pairs = [f(s, poses(q), seen(), seen(), DT) for f, s in zip((following, late), states, strict=True)]
        errors = [float(angle(T, poses(q)).max()) for _, T in pairs]
        off = [float((T - poses(q))[..., :3, 3].abs().max()) for _, T in pairs]
        change = DT * rate
        states = [f.moved(s, BACKBONE, points(), q, change) for f, (s, _) in zip((following, late), pairs, strict=True)]
        q = q + change
    # What is left is of second order in one step; the filter that stands still is late by about rate times time.
    assert errors[0] < 5e-3 < 0.1 < errors[1]
    assert off[0] < 1e-3 < 0.01 < off[1]


@pytest.mark.parametrize("oriented", [True, False])
@pytest.mark.parametrize("delay", [1, 3])
def test_late_readings_are_carried_on_to_where_the_arm_is_now(delay: int, oriented: bool) -> None:
    q, rate = scene(), 0.5 * normal((2, 9), torch.float64, generator(6))
    rate[:, 2::3] *= 0.1
    carrying, waiting = PoseFilter(0.0, 0.0, follow=1.0, delay=delay), PoseFilter(0.0, 0.0)
    turned = seen() if oriented else ~seen()
    states = [f.initial_state(q, 3) for f in (carrying, waiting)]
    past = [poses(q)] * delay
    T_now, T_late = poses(q), poses(q)
    for k in range(12):
        past.append(poses(q))
        reading = past[k].clone()
        if not oriented:
            reading[..., :3, :3] = torch.nan
        (first, T_now), (second, T_late) = (
            f(s, reading, seen(), turned, DT) for f, s in zip((carrying, waiting), states, strict=True)
        )
        if oriented:  # what the reading was is kept as it was, beside what has happened since
            assert torch.equal(first.T, past[k])
        change = DT * rate
        states = [f.moved(s, BACKBONE, points(), q, change) for f, s in ((carrying, first), (waiting, second))]
        q_now, q = q, q + change
    off, late = (float((T - poses(q_now))[..., :3, 3].norm(dim=-1).max()) for T in (T_now, T_late))
    assert off < 0.1 * late
    assert bool(T_now[..., :3, :3].isfinite().all()) is oriented
    if oriented:
        assert float(angle(T_now, poses(q_now)).max()) < 0.1 * float(angle(T_late, poses(q_now)).max())


def test_positions_that_come_without_orientations_move_as_the_model_says() -> None:
    q, change = scene(), 1e-3 * normal((2, 9), torch.float64, generator(7))
    poses_filter = PoseFilter(0.0, 0.0, follow=1.0)
    state, _ = poses_filter(poses_filter.initial_state(q, 3), poses(q), seen(), ~seen(), DT)
    state = poses_filter.moved(state, BACKBONE, points(), q, change)
    moved = state.T[..., :3, 3] - poses(q)[..., :3, 3]
    want = (poses(q + change) - poses(q))[..., :3, 3]
    torch.testing.assert_close(moved, want, rtol=0, atol=1e-5)
    assert float(want.norm(dim=-1).min()) > 1e-4


def test_noise_falls_by_the_gain_of_a_first_order_filter() -> None:
    rng = generator(3)
    spread, time = 8.7e-3, 0.1
    q = scene(200)
    poses_filter = PoseFilter(time, 0.0)
    state = poses_filter.initial_state(q, 3)
    T = poses(q)
    many = torch.ones(200, 3, dtype=torch.bool)
    for _ in range(40):
        state, T = poses_filter(state, noisy(poses(q), spread, rng), many, many, DT)
        state = poses_filter.moved(state, BACKBONE, points(200), q, torch.zeros_like(q))
    alpha = 1.0 - float(torch.exp(-DT / time))
    left = (alpha / (2.0 - alpha)) ** 0.5
    measured = float(angle(T, poses(q)).square().mean().sqrt()) / (spread * 3**0.5)
    assert measured == pytest.approx(left, rel=0.1)
    torch.testing.assert_close(T[..., :3, 3], poses(q)[..., :3, 3], rtol=0, atol=1e-15)


def test_a_sensor_that_is_missing_is_left_as_it_is_and_soon_believed_again() -> None:
    q = scene()
    poses_filter = PoseFilter(0.1, 0.1)
    state, _ = poses_filter(poses_filter.initial_state(q, 3), poses(q), seen(), seen(), DT)
    before = state.T
    usable = seen()
    usable[0, 1] = False
    T = poses(q)
    T[0, 1] = torch.nan
    for _ in range(10):
        state, filtered = poses_filter(state, T, usable, usable, DT)
        state = poses_filter.moved(state, BACKBONE, points(), q, torch.zeros_like(q))
    assert torch.equal(filtered[0, 1].isnan(), T[0, 1].isnan()) and filtered[usable].isfinite().all()
    torch.testing.assert_close(state.T, before, rtol=0, atol=1e-12)
    assert float(state.age[0, 1, 0]) == pytest.approx(0.2)
    # Back at another place: what counts is the time since it was last seen, not the last period.
    elsewhere = poses(q + 0.05)
    _, filtered = poses_filter(state, elsewhere, seen(), seen(), DT)
    share = angle(filtered, poses(q)) / angle(elsewhere, poses(q))
    assert float(share[0, 1]) == pytest.approx(1.0 - float(torch.exp(torch.tensor(-2.2))), abs=1e-6)
    assert float(share[1, 1]) == pytest.approx(1.0 - float(torch.exp(torch.tensor(-0.2))), abs=1e-6)


def test_an_orientation_that_is_masked_does_not_hold_up_its_position() -> None:
    q = scene()
    poses_filter = PoseFilter(0.1, 0.1)
    state, _ = poses_filter(poses_filter.initial_state(q, 3), poses(q), seen(), seen(), DT)
    oriented = seen()
    oriented[:, 0] = False
    T = poses(q + 0.05)
    later, filtered = poses_filter(state, T, seen(), oriented, DT)
    assert torch.equal(filtered[:, 0, :3, :3], T[:, 0, :3, :3])
    torch.testing.assert_close(later.T[:, 0, :3, :3], poses(q)[:, 0, :3, :3], rtol=0, atol=1e-12)
    assert bool((later.age[:, 0] == torch.tensor([0.02, 0.0], dtype=torch.float64)).all())
    left = torch.exp(-DT / 0.1)
    want = torch.lerp(T[:, 0, :3, 3], poses(q)[:, 0, :3, 3], left)
    torch.testing.assert_close(filtered[:, 0, :3, 3], want, rtol=0, atol=1e-12)


def test_the_world_may_be_turned() -> None:
    rng = generator(4)
    q = scene()
    poses_filter = PoseFilter(0.1, 0.1)
    G = se3.exp(normal((6,), torch.float64, rng))
    here, there = poses_filter.initial_state(q, 3), poses_filter.initial_state(q, 3)
    for k in range(4):
        T = noisy(poses((1.0 + 0.02 * k) * q), 0.01, rng)
        here, a = poses_filter(here, T, seen(), seen(), DT)
        there, b = poses_filter(there, G @ T, seen(), seen(), DT)
        torch.testing.assert_close(G @ a, b, rtol=0, atol=1e-12)
        here, there = (poses_filter.moved(s, BACKBONE, points(), q, 0.02 * q) for s in (here, there))


def test_rotations_stay_rotations() -> None:
    rng = generator(5)
    q = scene(4).float()
    poses_filter = PoseFilter(2.0, 0.0, follow=1.0)
    state = poses_filter.initial_state(q, 3)
    backbone, lengths = PCCBackbone(3, HANGING_BASE.float()), PI.float().expand(4, 3)
    at = backbone.material_points(lengths, *decouple(SENSORS.float().expand(4, 3), lengths))
    many, true = torch.ones(4, 3, dtype=torch.bool), poses(q.double())
    for k in range(2000):
        swing = 0.01 * torch.sin(torch.tensor(0.1 * k)) * q
        T = noisy(true, 0.01, rng).float()
        state, filtered = poses_filter(state, T, many, many, DT.float())
        state = poses_filter.moved(state, backbone, at, q, swing)
    R = filtered[..., :3, :3]
    torch.testing.assert_close(R.mT @ R, torch.eye(3).expand_as(R), rtol=0, atol=1e-5)


def test_gradients() -> None:
    q = scene(1)
    poses_filter = PoseFilter(0.1, 0.05, delay=1)
    state, _ = poses_filter(poses_filter.initial_state(q, 3), poses(q), seen(1), seen(1), DT)

    def step(q: Tensor, change: Tensor) -> Tensor:
        later = poses_filter.moved(state, BACKBONE, points(1), q, change)
        return poses_filter(later, poses(1.1 * q), seen(1), seen(1), DT)[1]

    inputs = (q.clone().requires_grad_(), (0.02 * q).requires_grad_())
    assert torch.autograd.gradcheck(step, inputs, atol=1e-7)


@pytest.mark.parametrize("name", ["angular_time", "linear_time", "follow"])
def test_bad_settings(name: str) -> None:
    with pytest.raises(ValueRangeError, match=f"^{name} must be zero or positive and finite, got -1.0$"):
        PoseFilter(**{name: -1.0})


def test_a_negative_delay() -> None:
    with pytest.raises(ValueRangeError, match=r"^delay must be in \[0, 10000\], got -1$"):
        PoseFilter(delay=-1)


def test_state_is_a_tuple_of_tensors() -> None:
    state = PoseFilter(delay=3).initial_state(torch.zeros(5, 9), 2)
    assert isinstance(state, PoseFilterState)
    assert state.T.shape == (5, 2, 4, 4) and state.age.shape == (5, 2, 2) and state.since.shape == (5, 3, 2, 4, 4)
