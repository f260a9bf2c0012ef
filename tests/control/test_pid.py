"""The tendon loop of section V-B: its formula by hand, its bounds, its integral, and the reference between commands."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from apcc_torch.control.pid import TendonPID, ramp
from apcc_torch.errors import DtypeError, ShapeError, ValueRangeError
from laws import bits, check_bad_row, check_batching, check_gradients, generator, normal, seeds, shapes


def signals(shape: tuple[int, ...], dtype: torch.dtype, rng: torch.Generator) -> tuple[Tensor, ...]:
    """z, y, ydot, y_d, ydot_d of two tendons."""
    return tuple(normal((*shape, 2), dtype, rng) for _ in range(5))


def test_force_by_hand() -> None:
    z, y, ydot, y_d, ydot_d = (torch.tensor([v], dtype=torch.float64) for v in (0.5, 0.01, 0.2, 0.03, 0.5))
    # 750 * 0.02 + 2 * 0.5 + 5 * 0.3 = 15 + 1 + 1.5
    assert TendonPID(750.0, 2.0, 5.0)(z, y, ydot, y_d, ydot_d).item() == pytest.approx(17.5, abs=1e-12)


def test_defaults_are_the_papers() -> None:
    pid = TendonPID()
    assert (pid.K_P, pid.K_I, pid.K_D, pid.force_limit, pid.integral_limit) == (750.0, 1.0, 5.0, None, None)


@given(seeds, shapes)
def test_each_gain_acts_on_its_own_error(seed: int, shape: tuple[int, ...]) -> None:
    z, y, ydot, y_d, ydot_d = signals(shape, torch.float64, generator(seed))
    for gains, want in {(3.0, 0, 0): 3 * (y_d - y), (0, 3.0, 0): 3 * z, (0, 0, 3.0): 3 * (ydot_d - ydot)}.items():
        torch.testing.assert_close(TendonPID(*gains)(z, y, ydot, y_d, ydot_d), want)


@given(seeds, st.floats(0.1, 50.0))
def test_force_limit_clips_both_ways_and_nothing_else(seed: int, limit: float) -> None:
    given_signals = signals((5,), torch.float64, generator(seed))
    free = TendonPID(20.0, 1.0, 5.0)(*given_signals)
    held = TendonPID(20.0, 1.0, 5.0, force_limit=limit)(*given_signals)
    assert bool((held.abs() <= limit).all())
    inside = free.abs() <= limit
    assert torch.equal(bits(held[inside]), bits(free[inside]))
    assert torch.equal(held[~inside], limit * free[~inside].sign())


def test_integral_of_a_constant_error_grows_linearly_and_stops_at_its_limit() -> None:
    y, y_d = torch.zeros(2, dtype=torch.float64), torch.tensor([0.1, -0.1], dtype=torch.float64)
    free, held = TendonPID(), TendonPID(integral_limit=0.02)
    z_free = z_held = torch.zeros_like(y)
    for _ in range(100):
        z_free, z_held = free.integrate(z_free, y, y_d, 0.01), held.integrate(z_held, y, y_d, 0.01)
    torch.testing.assert_close(z_free, y_d)  # 100 * 0.01 s
    assert z_held.tolist() == [0.02, -0.02]
    # A limit is no memory: it leaves at once when the error turns.
    torch.testing.assert_close(held.integrate(z_held, y_d, y, 0.01), 0.19 * y_d)


def test_integral_removes_the_offset_of_a_constant_load() -> None:
    # A mass on a damper pulled by a constant force: with K_I it ends on the reference, without it K_P y = load.
    dt, load = 0.01, torch.tensor([2.0], dtype=torch.float64)
    for K_I, want in ((0.0, 0.2), (5.0, 0.0)):
        pid = TendonPID(10.0, K_I, 1.0)
        y = ydot = z = torch.zeros(1, dtype=torch.float64)
        for _ in range(4000):
            ydot = ydot + dt * (pid(z, y, ydot, torch.zeros_like(y), torch.zeros_like(y)) + load - 2.0 * ydot)
            y = y + dt * ydot
            z = pid.integrate(z, y, torch.zeros_like(y), dt)
        assert y.item() == pytest.approx(want, abs=1e-6)


def test_ramp_joins_two_commands() -> None:
    previous, y = (torch.tensor(v, dtype=torch.float64) for v in ([0.0, 1.0], [0.2, -1.0]))
    for share, want in ((0.0, previous), (0.25, torch.tensor([0.05, 0.5], dtype=torch.float64)), (1.0, y)):
        torch.testing.assert_close(ramp(previous, y, share, 0.5).y_d, want)
        torch.testing.assert_close(ramp(previous, y, share, 0.5).ydot_d, (y - previous) / 0.5)


def test_batches_and_keeps_rows_apart() -> None:
    pid = TendonPID(20.0, 1.0, 5.0, force_limit=30.0, integral_limit=1.0)
    check_batching(pid, signals, shared=range(5))
    check_batching(lambda z, y, y_d: pid.integrate(z, y, y_d, 0.01), lambda *a: signals(*a)[:3], shared=range(3))
    check_bad_row(pid, signals((3,), torch.float64, generator()))
    check_gradients(TendonPID(2.0, 1.0, 0.5), *signals((2,), torch.float64, generator()))


@pytest.mark.parametrize("name", ["K_P", "K_I", "K_D"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_bad_gains_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueRangeError, match=name):
        TendonPID(**{name: value})


@pytest.mark.parametrize("name", ["force_limit", "integral_limit"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_limits_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueRangeError, match=name):
        TendonPID(**{name: value})


def test_bad_tensors_are_refused() -> None:
    y = torch.zeros(3)
    with pytest.raises(ShapeError, match="y_d"):
        TendonPID()(y, y, y, torch.zeros(2), y)
    with pytest.raises(DtypeError, match="y_d"):
        TendonPID()(y, y, y, y.double(), y)
