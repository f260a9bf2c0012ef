"""Sensors as they are: the truth where nothing is set, and noise, delay and dropout of the sizes asked for."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apcc_torch.errors import ShapeError, ValueRangeError
from apcc_torch.lie import so3
from apcc_torch.simulation.sensors import PoseSensors, SensorState
from laws import FLOATS, bits, generator, poses


def read(sensors: PoseSensors, T: Tensor, seed: int = 0) -> tuple[SensorState, Tensor, Tensor]:
    return sensors(sensors.initial_state(T), T, generator(seed))


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("shape", [(2,), (4, 3)])
def test_zero_settings_return_the_truth(dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    T = poses(shape, dtype, generator())
    _, seen, mask = read(PoseSensors(), T)
    assert torch.equal(bits(seen), bits(T)) and seen.dtype == dtype
    assert mask.shape == shape and mask.dtype == torch.bool and bool(mask.all())


def test_perfect_sensors_draw_no_random_numbers() -> None:
    rng = generator(3)
    before = rng.get_state()
    sensors, T = PoseSensors(delay=2), poses((2,), torch.float64, generator())
    sensors(sensors.initial_state(T), T, rng)
    assert torch.equal(before, rng.get_state())


def test_noise_has_the_size_asked_for_and_no_bias() -> None:
    sigma_p, sigma_a, N = 2e-3, 0.03, 20_000
    T = poses((1,), torch.float64, generator()).expand(N, 1, 4, 4)
    _, seen, _ = read(PoseSensors(sigma_p, sigma_a), T)
    shift = seen[:, 0, :3, 3] - T[:, 0, :3, 3]
    turn = so3.log(T[:, 0, :3, :3].mT @ seen[:, 0, :3, :3])
    for noise, sigma in ((shift, sigma_p), (turn, sigma_a)):
        # Four standard errors of the mean, and of the standard deviation, of every component.
        assert bool((noise.mean(0).abs() < 4 * sigma / math.sqrt(N)).all())
        assert bool((noise.std(0) / sigma - 1).abs().max() < 4 / math.sqrt(2 * N))
    together = torch.corrcoef(torch.cat((shift, turn), dim=-1).mT) - torch.eye(6, dtype=torch.float64)
    assert float(together.abs().max()) < 5 / math.sqrt(N)


def test_measured_poses_stay_poses() -> None:
    T = poses((50, 3), torch.float64, generator())
    _, seen, _ = read(PoseSensors(1e-3, 0.5), T)
    R = seen[..., :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R), rtol=0, atol=1e-12)
    assert torch.equal(seen[..., 3, :], T[..., 3, :])


def test_one_kind_of_noise_leaves_the_other_part_alone() -> None:
    T = poses((5, 2), torch.float64, generator())
    _, seen, _ = read(PoseSensors(position_noise=1e-3), T)
    assert torch.equal(seen[..., :3, :3], T[..., :3, :3]) and not torch.equal(seen[..., 3], T[..., 3])
    _, seen, _ = read(PoseSensors(angular_noise=1e-3), T)
    assert torch.equal(seen[..., 3], T[..., 3]) and not torch.equal(seen[..., :3, :3], T[..., :3, :3])


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_delay_is_exact(delay: int) -> None:
    sensors = PoseSensors(delay=delay)
    true = poses((8, 2), torch.float64, generator())  # eight readings of two sensors
    state = sensors.initial_state(true[0])
    for k in range(8):
        state, seen, _ = sensors(state, true[k])
        assert torch.equal(seen, true[max(0, k - delay)])


def test_dropout_has_the_rate_asked_for_and_strikes_each_sensor_alone() -> None:
    N, rate = 20_000, 0.2
    T = torch.eye(4, dtype=torch.float64).expand(N, 2, 4, 4)
    _, seen, mask = read(PoseSensors(dropout=rate), T)
    assert torch.equal(seen, T)  # a mask, not a changed pose
    missing = (~mask).double()
    assert bool((missing.mean(0) - rate).abs().max() < 4 * math.sqrt(rate * (1 - rate) / N))
    both = float(missing.prod(-1).mean())
    assert abs(both - rate**2) < 4 * math.sqrt(rate**2 * (1 - rate**2) / N)


def test_tendons_are_measured_with_noise_and_shorter_than_they_are_where_they_are_pulled() -> None:
    N, T = 20_000, torch.eye(4, dtype=torch.float64).expand(1, 4, 4)
    y, u = torch.tensor([0.01, -0.02], dtype=torch.float64), torch.tensor([-10.0, 0.0], dtype=torch.float64)
    sensors = PoseSensors(tendon_noise=5e-4, tendon_stretch=1e-4)
    rows = T.expand(N, 1, 4, 4)
    seen = sensors.measured_tendons(y, u, sensors.draw(rows, generator(), 2))
    assert seen.shape == (N, 2)
    # A tendon under 10 N is a millimetre longer than what its motor has paid out.
    torch.testing.assert_close(seen.mean(0), y - torch.tensor([1e-3, 0.0]).double(), rtol=0, atol=2e-5)
    torch.testing.assert_close(seen.std(0), torch.full((2,), 5e-4).double(), rtol=0.05, atol=0)
    plain = PoseSensors()
    assert plain.measured_tendons(y, u, plain.draw(rows, generator(), 2)) is y


def test_the_generator_alone_decides() -> None:
    sensors, T = PoseSensors(1e-3, 1e-2, 1, 0.3), poses((4, 3), torch.float64, generator())
    torch.manual_seed(1)
    first, again, other = read(sensors, T, 7), read(sensors, T, 7), read(sensors, T, 8)
    torch.manual_seed(2)
    assert all(torch.equal(a, b) for a, b in zip(first[1:], again[1:], strict=True))
    assert all(torch.equal(a, b) for a, b in zip(first[1:], read(sensors, T, 7)[1:], strict=True))
    assert not torch.equal(first[1], other[1]) and not torch.equal(first[2], other[2])
    state = torch.random.get_rng_state()
    read(sensors, T, 7)
    assert torch.equal(state, torch.random.get_rng_state()), "an explicit generator leaves torch's own alone"


def test_state_and_truth_are_not_written_to() -> None:
    sensors, T = PoseSensors(1e-3, 1e-2, 2, 0.3), poses((3,), torch.float64, generator())
    state = sensors.initial_state(T)
    before, truth = state.queue.clone(), T.clone()
    later, _, _ = sensors(state, poses((3,), torch.float64, generator(1)), generator())
    assert torch.equal(state.queue, before) and torch.equal(T, truth) and not torch.equal(later.queue, before)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, value) for name in ("position_noise", "angular_noise") for value in (-1e-3, math.nan, math.inf)),
        ("delay", -1),
        ("dropout", -0.1),
        ("dropout", 1.0),
        ("dropout", math.nan),
    ],
)
def test_bad_settings_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueRangeError, match=name):
        PoseSensors(**{name: value})


def test_bad_poses_are_refused() -> None:
    with pytest.raises(ShapeError, match="T must have shape"):
        PoseSensors().initial_state(torch.zeros(2, 3, 4))
