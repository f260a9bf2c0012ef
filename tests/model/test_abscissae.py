"""Algorithm 1 against a plain loop over points and sections."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from apcc_torch.errors import DtypeError, ShapeError
from apcc_torch.model.abscissae import decouple, section_fractions
from apcc_torch.model.backbone import PCCBackbone
from arms import configurations
from laws import FLOATS, generator, uniform

lengths = st.lists(st.floats(0.01, 0.5), min_size=1, max_size=6)


def algorithm_1(points: list[float], pi_hat: list[float], dtype: torch.dtype) -> tuple[list[float], list[int]]:
    """The printed loop, with remark 3 for points beyond the tip."""
    # Sums are rounded once, as torch does.
    rounded = torch.tensor(pi_hat, dtype=dtype).tolist()
    cumulative = [torch.tensor(sum(rounded[:m]), dtype=dtype) for m in range(len(pi_hat) + 1)]
    X_tilde, sections = [], []
    for point in points:
        X = torch.tensor(point, dtype=dtype)
        reached = [m for m in range(1, len(cumulative)) if cumulative[m] >= X]
        if not reached:
            X_tilde.append(1.0)
            sections.append(len(pi_hat) - 1)
            continue
        j = min(reached)
        length = torch.tensor(pi_hat[j - 1], dtype=dtype)
        X_tilde.append(float((X - cumulative[j - 1]) / length))
        sections.append(j - 1)
    return X_tilde, sections


@given(data=st.data(), dtype=st.sampled_from(FLOATS))
def test_against_the_loop(data: st.DataObject, dtype: torch.dtype) -> None:
    n, rows = data.draw(st.integers(1, 6)), data.draw(st.integers(1, 4))
    pi_hat = [data.draw(st.lists(st.floats(0.01, 0.5), min_size=n, max_size=n)) for _ in range(rows)]
    # Anywhere, beyond the tip, and on the boundaries as this dtype rounds them.
    ends = torch.tensor(pi_hat, dtype=dtype).cumsum(-1).flatten().tolist()
    point = st.one_of(st.floats(0.0, 4.0), st.sampled_from([0.0, *ends]))
    X = data.draw(st.lists(point, min_size=1, max_size=5))
    X_tilde, j = decouple(torch.tensor(X, dtype=dtype), torch.tensor(pi_hat, dtype=dtype))
    assert j.dtype == torch.int64 and X_tilde.dtype == dtype
    for row in range(rows):
        want, sections = algorithm_1(X, pi_hat[row], dtype)
        assert j[row].tolist() == sections
        rounding = 8 * torch.finfo(dtype).eps * sum(pi_hat[row]) / min(pi_hat[row])
        torch.testing.assert_close(X_tilde[row], torch.tensor(want, dtype=dtype), rtol=0, atol=rounding)


@given(pi_hat=lengths)
def test_boundaries_belong_to_the_section_that_ends_there(pi_hat: list[float]) -> None:
    rest = torch.tensor(pi_hat, dtype=torch.float64)
    ends = rest.cumsum(0)
    X_tilde, j = decouple(ends, rest)
    assert j.tolist() == list(range(len(pi_hat)))
    torch.testing.assert_close(X_tilde, torch.ones_like(ends), rtol=0, atol=1e-12)
    X_tilde, j = decouple(torch.cat((torch.zeros(1).double(), ends[-1:] + 1.0)), rest)
    assert j.tolist() == [0, len(pi_hat) - 1]
    assert X_tilde.tolist() == [0.0, 1.0]


def test_broadcasts_both_ways() -> None:
    rng = generator(0)
    X, pi_hat = uniform((4, 1, 5), 0.0, 0.8, torch.float64, rng), uniform((3, 3), 0.1, 0.3, torch.float64, rng)
    X_tilde, j = decouple(X, pi_hat)
    assert X_tilde.shape == j.shape == (4, 3, 5)
    for a in range(4):
        for b in range(3):
            each = decouple(X[a, 0], pi_hat[b])
            assert torch.equal(X_tilde[a, b], each[0]) and torch.equal(j[a, b], each[1])
    one = decouple(X[0, 0], pi_hat)
    assert torch.equal(one[0], X_tilde[0]) and torch.equal(one[1], j[0])


@pytest.mark.parametrize("boundary", [0, 1, 2])
def test_crossing_a_boundary_is_finite_and_continuous(boundary: int) -> None:
    backbone = PCCBackbone(3)
    q = configurations((), 3, torch.float64, generator(1))
    pi_hat = torch.tensor([0.1, 0.25, 0.24], dtype=torch.float64)
    X = pi_hat.cumsum(0)[boundary : boundary + 1]
    poses: list[Tensor] = []
    for shift in (-1e-3, -1e-9, 0.0, 1e-9, 1e-3):
        moved = pi_hat.clone()
        moved[boundary] += shift
        moved.requires_grad_()
        pose = backbone.pose(q, moved, *decouple(X, moved))
        (slope,) = torch.autograd.grad(pose[..., :3, :].sum(), moved)
        assert torch.isfinite(pose).all() and torch.isfinite(slope).all()
        poses.append(pose.detach())
    for k in (1, 3):
        torch.testing.assert_close(poses[k], poses[2], rtol=0, atol=1e-7)
    for k in (0, 4):
        torch.testing.assert_close(poses[k], poses[2], rtol=0, atol=2e-2)


@given(pi_hat=lengths, seed=st.integers(0, 1000))
def test_section_fractions_measure_the_arm_up_to_the_point(pi_hat: list[float], seed: int) -> None:
    rest = torch.tensor(pi_hat, dtype=torch.float64)
    X = uniform((6,), 0.0, 1.2 * float(rest.sum()), torch.float64, generator(seed))
    X_tilde, j = decouple(X, rest)
    fractions = section_fractions(X_tilde, j, len(pi_hat))
    torch.testing.assert_close(fractions @ rest, X.clamp(max=rest.cumsum(0)[-1]), rtol=0, atol=1e-12)
    for k in range(6):
        for m in range(len(pi_hat)):
            want = 1.0 if m < j[k] else float(X_tilde[k]) if m == j[k] else 0.0
            assert float(fractions[k, m]) == want


def test_refusals() -> None:
    X, pi_hat = torch.ones(2).double(), torch.ones(3).double()
    with pytest.raises(ShapeError, match="X must have shape"):
        decouple(X[0], pi_hat)
    with pytest.raises(ShapeError, match="pi_hat must have shape"):
        decouple(X, pi_hat[0])
    with pytest.raises(DtypeError, match="pi_hat"):
        decouple(X, pi_hat.float())
    with pytest.raises(DtypeError, match="X must be a floating-point tensor"):
        decouple(X.long(), pi_hat)
    with pytest.raises(ShapeError, match=r"X \(4,\), pi_hat \(5,\)"):
        decouple(X.expand(4, 2), pi_hat.expand(5, 3))
