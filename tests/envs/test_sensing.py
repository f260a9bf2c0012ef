"""Late and noisy readings."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.envs.sensing import Sensing
from apcc_torch.envs.streams import streams
from arm_rows import make, row_parameters
from laws import generator

CPU = torch.device("cpu")


@given(st.lists(st.integers(0, 4), min_size=1, max_size=5))
def test_each_row_is_late_by_its_own_delay(delays: list[int]) -> None:
    n = len(delays)
    rows = row_parameters(n, delay=torch.tensor(delays))
    path = torch.randn(9, n, 9, dtype=torch.float64, generator=generator(0))
    sensing, stream = Sensing(False, 4), streams(0, n, CPU)
    stream, readings = sensing.initial(path[0], rows, stream)
    for k in range(1, 9):
        stream, readings = sensing.read(readings, path[k], rows, stream)
        for i, delay in enumerate(delays):
            assert torch.equal(readings.seen[i], path[max(k - delay, 0), i])
            assert torch.equal(readings.before[i], path[max(k - 1 - delay, 0), i])


def test_noise_has_each_rows_own_spread() -> None:
    rows = row_parameters(3, noise=torch.tensor([0.0, 1e-3, 5e-3], dtype=torch.float64))
    sensing, stream = Sensing(True, 0), streams(0, 3, CPU)
    still = torch.zeros(3, 9, dtype=torch.float64)
    stream, readings = sensing.initial(still, rows, stream)
    seen = []
    for _ in range(300):
        stream, readings = sensing.read(readings, still, rows, stream)
        seen.append(readings.seen)
    spread = torch.stack(seen).transpose(0, 1).flatten(1).std(-1)
    assert spread.tolist() == pytest.approx([0.0, 1e-3, 5e-3], rel=0.06)


def test_an_environment_observes_what_its_sensors_read() -> None:
    exact, late = make(), make(delay=(2, 2))
    paths: list[list[torch.Tensor]] = []
    for envs in (exact, late):
        observation, _ = envs.reset(seed=0)
        path = [observation[:, :9]]
        for _ in range(6):
            observation, *_ = envs.step(torch.ones(6, 9))
            path.append(observation[:, :9])
        paths.append(path)
    for k in range(2, 7):
        assert torch.equal(paths[1][k], paths[0][k - 2])
    velocity = (paths[1][6] - paths[1][5]) / 0.01
    torch.testing.assert_close(observation[:, 9:18], velocity, rtol=1e-3, atol=1e-3)
