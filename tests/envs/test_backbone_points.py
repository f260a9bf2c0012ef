"""The fast positions against the backbone's own."""

from __future__ import annotations

import pytest
import torch

from apcc_torch.envs.backbone_points import backbone_points, powers
from apcc_torch.model.backbone import PCCBackbone
from arms import HANGING_BASE, configurations, rest_lengths
from laws import FLOATS, TOLERANCE, generator


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("fractions", [(1.0,), (0.25, 0.5, 1.0)])
@pytest.mark.parametrize("n", [1, 3, 6])
def test_equals_the_backbones_poses(n: int, fractions: tuple[float, ...], dtype: torch.dtype) -> None:
    rng = generator(n)
    q, lengths = configurations((5,), n, dtype, rng), rest_lengths((5,), n, dtype, rng)
    base = HANGING_BASE.to(dtype)
    points = backbone_points(q, lengths, base, powers(fractions, q))
    X_tilde = torch.tensor(fractions * n, dtype=dtype).expand(5, -1)
    j = torch.arange(n).repeat_interleave(len(fractions)).expand(5, -1)
    want = PCCBackbone(n, base).pose(q, lengths, X_tilde, j)[..., :3, 3]
    torch.testing.assert_close(points, want, rtol=TOLERANCE[dtype][0], atol=TOLERANCE[dtype][1])
