"""Random numbers that belong to a row: SplitMix64 itself, its statistics, and what a row's numbers depend on."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.envs.streams import Stream, streams

CPU = torch.device("cpu")
MASK = 2**64 - 1


def splitmix64(state: int, draws: int) -> list[int]:
    """Steele, Lea and Flood's generator in exact integers."""
    found = []
    for _ in range(draws):
        state = (state + 0x9E3779B97F4A7C15) & MASK
        z = state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
        found.append(z ^ (z >> 31))
    return found


@given(st.integers(0, 2**63 - 1))
def test_uniform_is_splitmix64(key: int) -> None:
    stream = Stream(torch.tensor([key]), torch.zeros(1, dtype=torch.int64))
    _, u = stream.uniform(5, torch.float64)
    assert u[0].tolist() == [(z >> 11) * 2.0**-53 for z in splitmix64(key, 5)]


@given(st.integers(0, 2**63 - 1), st.integers(1, 7), st.integers(1, 7))
def test_a_stream_goes_on_where_it_stood(seed: int, first: int, second: int) -> None:
    start = streams(seed, 3, CPU)
    whole = start.uniform(first + second, torch.float64)[1]
    later, left = start.uniform(first, torch.float64)
    right = later.uniform(second, torch.float64)[1]
    assert torch.equal(whole, torch.cat((left, right), dim=-1))


def test_a_row_does_not_depend_on_how_many_there_are() -> None:
    few, many = (streams(7, n, CPU).normal(4, torch.float32)[1] for n in (3, 50))
    assert torch.equal(few, many[:3])


def test_keys_differ_between_rows_and_seeds() -> None:
    keys = torch.cat([streams(seed, 500, CPU).key for seed in range(4)])
    assert len(keys.unique()) == 2000


def test_statistics() -> None:
    stream = streams(0, 2000, CPU)
    stream, u = stream.uniform(50, torch.float64)
    _, z = stream.normal(50, torch.float64)
    n = u.numel() ** 0.5  # five standard errors each
    assert abs(u.mean() - 0.5) < 5 * 12**-0.5 / n and abs(u.var() - 1 / 12) < 5 * 180**-0.5 / n
    assert abs(z.mean()) < 5 / n and abs(z.var() - 1) < 5 * 2**0.5 / n and abs((z**4).mean() - 3) < 5 * 96**0.5 / n
    across, along = u[1:] - 0.5, u[:-1] - 0.5
    assert abs((across * along).mean()) < 5 / 12 / n  # neighbouring rows
    assert abs(((u[:, 1:] - 0.5) * (u[:, :-1] - 0.5)).mean()) < 5 / 12 / n  # neighbouring draws
