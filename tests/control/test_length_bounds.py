"""Bounds of the rest lengths, after steps of Eq. (15): a share of the nominal ones, and the projection onto a reach."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.errors import ConfigError, ShapeError, ValueRangeError
from arms import PI, PI_HAT
from laws import bits, check_bad_row, generator, normal, seeds

GAMMA = torch.tensor([90.0, 42.5, 35.0], dtype=torch.float64)
DT = torch.tensor(0.01, dtype=torch.float64)
FREE: dict[str, Any] = {"lower": None, "upper": None}


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def stepped(seed: int, gamma: Tensor = GAMMA, rows: int = 5) -> Tensor:
    """pi_hat (rows, 3) after one step of Eq. (15), some of it far away."""
    rng = generator(seed)
    Y, e = normal((rows, 3, 3), torch.float64, rng), 0.1 * normal((rows, 3), torch.float64, rng)
    return AdaptiveLaw(3, gamma)(PI_HAT.repeat(rows, 1), Y, e, DT)


@given(seed=seeds)
def test_every_section_stays_between_its_shares(seed: int) -> None:
    moved = stepped(seed)
    lower, upper = PI_HAT - 0.02, PI_HAT + tensor(0.01, 0.03, 0.02)
    shares = {"lower": lower / PI_HAT, "upper": upper / PI_HAT}
    both = LengthBounds(PI_HAT, reach="free", **shares)
    assert both.least is not None and both.largest is not None
    torch.testing.assert_close(both.least, lower, rtol=1e-15, atol=0)
    torch.testing.assert_close(both.largest, upper, rtol=1e-15, atol=0)
    assert torch.equal(both(moved), torch.minimum(torch.maximum(moved, both.least), both.largest))
    below = LengthBounds(PI_HAT, reach="free", **{**FREE, "lower": shares["lower"]})
    above = LengthBounds(PI_HAT, reach="free", **{**FREE, "upper": shares["upper"]})
    assert torch.equal(below(moved), torch.maximum(moved, both.least))
    assert torch.equal(above(moved), torch.minimum(moved, both.largest))
    assert torch.equal(bits(LengthBounds(PI_HAT, reach="free", **FREE)(moved)), bits(moved))


@given(seed=seeds)
def test_reach_is_the_projection_that_v_measures(seed: int) -> None:
    root = normal((3, 3), torch.float64, generator(seed))
    for gamma in (torch.diag(GAMMA), root @ root.mT + torch.eye(3, dtype=torch.float64)):
        moved = stepped(seed, gamma)
        reach = max(float(moved.sum(-1).median()), 0.1)
        bounds = LengthBounds(PI_HAT, tensor(0.01, reach), reach="last", **FREE)
        held = bounds(moved, gamma)
        torch.testing.assert_close(held.sum(-1), moved.sum(-1).clamp(min=reach))
        # The nearest point of the half-space in the norm of Gamma^-1: the way there is at a right angle to it.
        push = torch.linalg.solve(gamma, (held - moved).mT).mT
        torch.testing.assert_close(push, push.mean(-1, keepdim=True).expand_as(push), rtol=1e-6, atol=1e-9)
        # So the parameters' part of V falls for whatever rest lengths reach as far.
        pi = 0.1 + torch.rand(50, 1, 3, dtype=torch.float64, generator=generator(seed))
        pi = pi * (reach / pi.sum(-1, keepdim=True)).clamp(min=1.0)

        def V(estimate: Tensor, pi: Tensor = pi, gamma: Tensor = gamma) -> Tensor:
            error = (pi - estimate).unsqueeze(-1)
            return (error.mT @ torch.linalg.solve(gamma, error)).squeeze(-1).squeeze(-1)

        assert (V(held) <= V(moved) * (1 + 1e-9) + 1e-12).all()
        # Without a metric it is the nearest point as such: all sections take the same.
        evenly = bounds(moved) - moved
        torch.testing.assert_close(evenly, evenly.mean(-1, keepdim=True).expand_as(evenly), rtol=1e-6, atol=1e-12)
        torch.testing.assert_close(bounds(moved).sum(-1), moved.sum(-1).clamp(min=reach))


@given(seed=seeds)
def test_with_a_reach_for_each_the_first_sections_reach_their_sensor(seed: int) -> None:
    moved, ends = stepped(seed), tensor(0.11, 0.38, 0.64)
    bounds = LengthBounds(PI_HAT, ends, reach="each", **FREE)
    held = bounds(moved, torch.diag(GAMMA))
    assert (held.cumsum(-1) >= ends - 1e-12).all()
    # By hand, half-space by half-space: what the first i lack is shared among them as Gamma shares it.
    want = moved
    for i in (1, 2, 3):
        short = (ends[i - 1] - want[:, :i].sum(-1)).clamp(min=0.0)
        share = torch.cat((GAMMA[:i], torch.zeros(3 - i, dtype=torch.float64))) / GAMMA[:i].sum()
        want = want + short.unsqueeze(-1) * share
    torch.testing.assert_close(held, want)
    # What reaches all of them is left as it is, bit for bit.
    far = PI_HAT.expand(2, 3)
    assert torch.equal(bits(bounds(far, torch.diag(GAMMA))), bits(far))


def test_the_reach_comes_after_the_shares_and_may_leave_them() -> None:
    bounds = LengthBounds(PI, PI.cumsum(0), lower=0.5, upper=0.9, reach="last")
    held = bounds(tensor(0.01, 1.0, 0.2))
    cut = torch.minimum(torch.maximum(tensor(0.01, 1.0, 0.2), 0.5 * PI), 0.9 * PI)
    torch.testing.assert_close(held, cut + (PI.sum() - cut.sum()) / 3)
    assert (held > 0.9 * PI).any()


def test_by_default_a_section_is_no_shorter_than_a_fifth_and_no_longer_than_five_times() -> None:
    bounds = LengthBounds(PI, tensor(0.2, 0.55))
    assert bounds.least is not None and bounds.largest is not None and bounds.ends is None
    assert torch.equal(bounds.least, 0.2 * PI) and torch.equal(bounds.largest, 5.0 * PI)
    assert torch.equal(bounds(0.1 * PI), 0.2 * PI) and torch.equal(bounds(7.0 * PI), 5.0 * PI)


def test_the_last_sensor_is_on_the_arm() -> None:
    bounds = LengthBounds(PI, tensor(0.2, 0.55), reach="last")
    assert bounds.ends is not None and bounds.ends.tolist() == [0.0, 0.0, 0.55]
    assert float(bounds(0.1 * PI).sum()) == pytest.approx(0.55)


def test_a_share_is_one_number_one_a_section_or_a_profile() -> None:
    alike = LengthBounds(PI, reach="free", lower=0.5)
    for share in ([0.5, 0.5, 0.5], (0.5, 0.5, 0.5), ["along", 0.5], torch.full((3,), 0.5)):
        made = LengthBounds(PI, reach="free", lower=share)
        assert made.least is not None and alike.least is not None and torch.equal(made.least, alike.least)
    profile = LengthBounds(torch.ones(6).double(), reach="free", upper=None, lower=["along", 0.2, 0.4, 0.6])
    assert profile.least is not None
    torch.testing.assert_close(profile.least, tensor(0.2, 0.25, 0.35, 0.45, 0.55, 0.6))


@pytest.mark.parametrize("reach", ["free", "last", "each"])
def test_rows_have_nominal_lengths_shares_and_sensors_of_their_own(reach: str) -> None:
    moved = stepped(3, rows=3)
    nominal = torch.stack((PI, PI_HAT, 0.9 * PI))
    sensors = torch.stack((tensor(0.0, 0.0, 0.7), tensor(0.2, 0.5, 0.6), tensor(0.0, 0.45, 0.5)))
    sensors = sensors.clamp(min=0.0) + tensor(0.01, 0.02, 0.03)
    lower = torch.stack((tensor(0.9, 0.99, 0.8), tensor(0.7, 0.8, 0.9), tensor(1.0, 1.1, 1.2)))
    gamma = torch.stack((torch.eye(3), 5.0 * torch.eye(3), torch.diag(torch.tensor([1.0, 2.0, 3.0])))).double()
    together = LengthBounds(nominal, sensors, lower=lower, upper=2.0, reach=reach)(moved, gamma)
    for row in range(3):
        one = LengthBounds(nominal[row], sensors[row], lower=lower[row], upper=2.0, reach=reach)
        torch.testing.assert_close(together[row], one(moved[row], gamma[row]))
    check_bad_row(LengthBounds(PI, PI.cumsum(0), reach=reach), (moved,))


def test_single_precision_stays_single() -> None:
    bounds = LengthBounds(PI, PI.cumsum(0), reach="each").to(torch.float32)
    held = bounds(0.5 * PI.float(), torch.diag(GAMMA).float())
    assert held.dtype == torch.float32
    torch.testing.assert_close(held.double(), LengthBounds(PI, PI.cumsum(0), reach="each")(0.5 * PI, torch.diag(GAMMA)))


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"lower": tensor(0.9, 0.0, 0.9)}, ValueRangeError, "lower must be positive and finite, got 0.0"),
        ({"lower": tensor(0.9, torch.nan, 0.9)}, ValueRangeError, "lower must be positive and finite, got nan"),
        ({"lower": -1.0}, ValueRangeError, "lower must be positive and finite, got -1.0"),
        ({"upper": float("inf")}, ValueRangeError, "upper must be positive and finite, got inf"),
        ({"lower": 1.0, "upper": 1.0}, ValueRangeError, "lower must be below upper for every section"),
        ({"lower": [0.5, 5.5, 0.5]}, ValueRangeError, "lower must be below upper for every section"),
        ({"upper": tensor(1.1, 1.2)}, ConfigError, "upper must have 3 entries, got 2"),
        ({"upper": [1.1, 1.2]}, ConfigError, "upper must have 3 entries, got 2"),
        ({"reach": "first"}, ConfigError, "reach must be one of free, last, each, got 'first'"),
        ({"reach": 0.6}, ConfigError, "reach must be"),
        ({"abscissae": None, "reach": "last"}, ConfigError, "reach=last needs the sensors' abscissae"),
        ({"abscissae": None, "reach": "each"}, ConfigError, "reach=each needs the sensors' abscissae"),
        ({"abscissae": tensor(0.2, 0.6), "reach": "each"}, ConfigError, "one sensor a section, got 2 for 3"),
        ({"abscissae": tensor(0.5, 0.4, 0.6), "reach": "each"}, ValueRangeError, "abscissae"),
        ({"abscissae": tensor(0.1, 0.2, torch.nan), "reach": "last"}, ValueRangeError, "abscissae"),
        ({"abscissae": tensor(-1.0), "reach": "last"}, ValueRangeError, "abscissae"),
        ({"abscissae": tensor(torch.inf), "reach": "last"}, ValueRangeError, "abscissae"),
        ({"nominal": tensor(0.1, torch.inf, 0.2)}, ValueRangeError, "nominal is not finite"),
        ({"nominal": torch.tensor(0.2)}, ShapeError, "nominal must have shape"),
    ],
)
def test_refusals(settings: dict[str, Any], error: type[Exception], message: str) -> None:
    tensors = {"nominal": PI, "abscissae": PI.cumsum(0)}
    nominal, abscissae = (settings.get(name, value) for name, value in tensors.items())
    with pytest.raises(error, match=message):
        LengthBounds(nominal, abscissae, **{k: v for k, v in settings.items() if k not in tensors})
