"""The clamp of commands, against its definition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apcc_torch.errors import SafetyError, ValueRangeError
from apcc_torch.hardware.limits import CommandLimits

number = st.floats(-1.0, 1.0)


def limits(n: int = 1, rate: float = 0.2, step: float = 0.003) -> CommandLimits:
    return CommandLimits(n, lower=-0.03, upper=0.01, rate=rate, step=step)


@given(wanted=number, last=st.floats(-0.03, 0.01), elapsed=st.floats(0.0, 0.1))
def test_clamped_is_in_range_reachable_and_the_nearest_such(wanted: float, last: float, elapsed: float) -> None:
    sent, least, greatest = (float(v[0]) for v in limits().clamp(np.array([wanted]), (np.array([last]), elapsed)))
    reach = min(0.2 * elapsed, 0.003)
    low, high = max(-0.03, last - reach), min(0.01, last + reach)
    assert low - 1e-15 <= sent <= high + 1e-15 and (least, greatest) == pytest.approx((low, high), abs=1e-15)
    assert sent == pytest.approx(min(max(wanted, low), high), abs=1e-15)


def test_from_outside_it_goes_back_into_range() -> None:
    assert limits().clamp(np.array([0.5]), (np.array([0.02]), 0.01))[0] == 0.01


@pytest.mark.parametrize(("wanted", "last"), [(np.nan, 0.0), (np.inf, 0.0), (0.0, np.nan)])
def test_nothing_that_is_not_finite_is_clamped(wanted: float, last: float) -> None:
    with pytest.raises(SafetyError, match="finite"):
        limits().clamp(np.array([wanted]), (np.array([last]), 0.01))


@pytest.mark.parametrize("change", [{"rate": 0.0}, {"step": -1.0}, {"rate": np.inf}])
def test_limits_must_mean_something(change: dict[str, float]) -> None:
    with pytest.raises(ValueRangeError):
        limits(**change)


def test_inside_takes_a_margin_and_no_nan() -> None:
    assert limits().inside(np.array([0.0105]), 1e-3) and not limits().inside(np.array([0.0105]))
    assert not limits().inside(np.array([np.nan]), 1.0)
