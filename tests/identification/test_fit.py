"""The fit on recordings with known parameters: recovery, honest intervals, and what cannot be told."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.errors import DataError
from apcc_torch.identification.fit import correlation_length, fit
from apcc_torch.identification.intervals import coverage, disagreement, half_widths, intervals, unknown_directions
from apcc_torch.identification.tendon_arm import TendonArm
from identified_arms import SMALL, measured, parameters, random_drive

ARM = TendonArm(SMALL)


def test_known_parameters_lie_in_their_intervals_and_errors_reach_the_noise() -> None:
    blocks = parameters(pre_stretch=5e-4, offset=0.1, angle=0.05, tendon_stiffness=0.5, base_position=5e-3)
    truth = 1.5 * torch.sin(torch.arange(len(blocks), dtype=torch.float64))
    drive = random_drive(150, seed=1)
    found = fit(ARM, blocks, drive, measured(blocks, truth, drive, 2e-4, seed=2))
    deviation = found.covariance.diagonal().sqrt()
    assert float(((found.z - truth) / deviation).abs().max()) < 4.0
    assert found.noise == pytest.approx(2e-4, rel=0.1)
    assert found.correlation < 1.5
    well = [entry for entry in intervals(blocks, found) if entry.name.startswith("base_position")]
    assert all(entry.learned > 0.99 and entry.low < entry.value < entry.high for entry in well)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    blocks = parameters(pre_stretch=5e-4, base_position=5e-3)
    generator = torch.Generator().manual_seed(3)
    inside, total = 0, 0
    for trial in range(16):
        truth = torch.randn(len(blocks), generator=generator, dtype=torch.float64)
        drive = random_drive(30, seed=100 + trial)
        found = fit(ARM, blocks, drive, measured(blocks, truth, drive, 5e-4, seed=trial))
        values = blocks.values(truth)
        flat = [float(v) for name in ("pre_stretch", "base_position") for v in values[name]]
        for entry, true in zip(intervals(blocks, found), flat, strict=True):
            inside += entry.low <= true <= entry.high
            total += 1
    # 95 % of 144, and four standard deviations of that count.
    assert total == 144
    assert 0.95 * total - 4 * (total * 0.95 * 0.05) ** 0.5 <= inside <= total


def test_prediction_intervals_hold_what_was_held_back_as_often_as_they_say() -> None:
    blocks = parameters(pre_stretch=5e-4, base_position=5e-3, bending_rigidity=0.3)
    truth = torch.linspace(-1.0, 1.0, len(blocks), dtype=torch.float64)
    shares = []
    for trial in range(6):
        drive, later = random_drive(60, seed=trial), random_drive(60, seed=50 + trial)
        found = fit(ARM, blocks, drive, measured(blocks, truth, drive, 3e-4, seed=400 + trial))
        new = measured(blocks, truth, later, 3e-4, seed=500 + trial)
        values = blocks.values(found.z)
        shares.append(coverage(ARM.predict(later, values), half_widths(ARM, blocks, later, found), new))
    # 1080 coordinates of a body, in intervals that 180 others told each time.
    held = torch.stack(shares).mean(0)
    assert float(held.min()) >= 0.92 and float(held.max()) <= 0.98


def test_intervals_hold_the_truth_where_errors_last_through_a_movement() -> None:
    """Ten movements, each of which is shifted as a whole: least squares that takes samples one by one is too sure."""
    blocks = parameters(pre_stretch=5e-4, base_position=5e-3)
    generator = torch.Generator().manual_seed(4)
    inside, alone, predicted = [], [], []
    for trial in range(12):
        truth = torch.randn(len(blocks), generator=generator, dtype=torch.float64)
        groups = torch.arange(50) // 5
        drive, later = random_drive(50, seed=200 + trial), random_drive(50, seed=300 + trial)
        shifts = 1e-3 * torch.randn(2, 10, 2, 3, generator=generator, dtype=torch.float64)
        # A permutation, so that no autocorrelation tells what belongs together.
        order = torch.randperm(50, generator=generator)
        old, new = (
            measured(blocks, truth, d, 1e-4, seed=trial + 20 * k) + shifts[k][groups[order]]
            for k, d in enumerate((drive, later))
        )
        found = fit(ARM, blocks, drive, old, groups=groups[order])
        values = blocks.values(truth)
        flat = [float(v) for name in ("pre_stretch", "base_position") for v in values[name]]
        inside += [entry.low <= true <= entry.high for entry, true in zip(intervals(blocks, found), flat, strict=True)]
        alone += ((found.z - truth).abs() <= 1.96 * found.posterior.diagonal().sqrt()).tolist()
        widths = half_widths(ARM, blocks, later, found)
        predicted.append(coverage(ARM.predict(later, blocks.values(found.z)), widths, new).mean())
    assert sum(alone) / len(alone) < 0.85 < 0.91 <= sum(inside) / len(inside)
    assert 0.9 <= float(torch.stack(predicted).mean()) <= 0.99


def test_what_cannot_be_told_apart_is_named() -> None:
    # Only ratios of stiffness are seen without weight: the common scale of both is not.
    blocks = parameters(tendon_stiffness=0.5, bending_rigidity=0.5, axial_rigidity=0.5)
    blocks.blocks["gravity"].nominal.zero_()
    drive = random_drive(60, seed=4)
    found = fit(ARM, blocks, drive, measured(blocks, blocks.nominal(), drive, 1e-4, seed=5))
    least = unknown_directions(blocks, found, parts=10)[0]
    assert least.information < 1e-3
    assert len({weight > 0 for _, weight in least.parts}) == 1
    assert {name.split(":")[0] for name, _ in least.parts} == {
        "tendon_stiffness",
        "bending_rigidity",
        "axial_rigidity",
    }


def test_halves_of_one_recording_agree_and_different_arms_do_not() -> None:
    blocks = parameters(pre_stretch=5e-4, base_position=5e-3)
    drives = [random_drive(40, seed=s) for s in (7, 8)]
    truth = torch.full((len(blocks),), 0.5, dtype=torch.float64)
    same = [fit(ARM, blocks, d, measured(blocks, truth, d, 2e-4, seed=s)) for s, d in enumerate(drives)]
    other = fit(ARM, blocks, drives[1], measured(blocks, -truth, drives[1], 2e-4, seed=9))
    assert disagreement(*same) < 2.0 < 5.0 < disagreement(same[0], other)


def test_correlation_length_is_that_of_a_known_process() -> None:
    generator = torch.Generator().manual_seed(0)
    white = torch.randn(20000, 2, generator=generator, dtype=torch.float64)
    assert correlation_length(white) == pytest.approx(1.0, abs=0.1)
    state, states = torch.zeros(2, dtype=torch.float64), []
    for row in white:
        state = 0.8 * state + row
        states.append(state)
    # (1 + a) / (1 - a) for x' = a x + w.
    assert correlation_length(torch.stack(states)) == pytest.approx(9.0, rel=0.15)


def test_no_equilibrium_is_said() -> None:
    blocks = parameters(base_position=1e-3)
    blocks.blocks["bending_rigidity"].nominal.mul_(torch.nan)
    drive = random_drive(4, seed=1)
    with pytest.raises(DataError, match="no equilibrium"):
        fit(ARM, blocks, drive, torch.zeros(4, 2, 3, dtype=torch.float64))
