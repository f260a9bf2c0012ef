"""Adaptation online: it predicts before it looks, and it learns."""

from __future__ import annotations

import torch

from apcc_torch.identification.online import adapt
from apcc_torch.identification.tendon_arm import TendonArm
from identified_arms import SMALL, parameters, random_drive

ARM = TendonArm(SMALL, kinematic=True)


def test_a_prediction_depends_on_earlier_samples_only() -> None:
    blocks = parameters(offset=0.1, base_position=5e-3)
    drive = random_drive(12, seed=1, reach=1.0)
    positions = ARM.predict(drive, blocks.values(blocks.nominal() + 1.0))
    first, _ = adapt(ARM, blocks, drive, positions, noise=1e-3, walk=0.01)
    changed = positions.clone()
    changed[6:] += 0.05
    second, _ = adapt(ARM, blocks, drive, changed, noise=1e-3, walk=0.01)
    assert torch.equal(first[:7], second[:7])
    assert not torch.allclose(first[7:], second[7:], atol=1e-3)


def test_it_finds_the_parameters_that_made_the_recording() -> None:
    blocks = parameters(offset=0.1, base_position=5e-3)
    truth = torch.linspace(-1.0, 1.0, len(blocks), dtype=torch.float64)
    drive = random_drive(80, seed=2, reach=1.0)
    positions = ARM.predict(drive, blocks.values(truth))
    predictions, scores = adapt(ARM, blocks, drive, positions, noise=1e-4, walk=0.0)
    wrong = (predictions - positions).norm(dim=-1)
    assert float(wrong[0].max()) > 3e-3
    assert float(wrong[40:].max()) < 1e-4
    torch.testing.assert_close(scores[-1], truth, atol=0.05, rtol=0.0)
