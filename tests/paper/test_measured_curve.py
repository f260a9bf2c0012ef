"""The drawn curve of an arm that only its sensors tell: through them, and along the arcs between them."""

from __future__ import annotations

import torch

from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.paper.measured_curve import measured_curve
from arms import HANGING_BASE, PI, configurations
from laws import generator


def test_it_passes_the_sensors_and_follows_the_arcs_between_them() -> None:
    arm, ends, samples = PCCBackbone(3, HANGING_BASE), PI.cumsum(0), 8
    for q in configurations((4,), 3, torch.float64, generator(0), bend=0.55, elongation=0.02):
        curve = measured_curve(HANGING_BASE, T := arm.pose(q, PI, *decouple(ends, PI)), samples)
        torch.testing.assert_close(curve[samples - 1 :: samples], T[:, :3, 3])
        between = torch.arange(1, samples + 1).double() / samples
        X = ((ends - PI).unsqueeze(-1) + PI.unsqueeze(-1) * between).flatten()
        there = arm.pose(q, PI, *decouple(X, PI))
        # Its points are not quite evenly spaced, so they are compared across the arm.
        off = there[:, :3, :3].mT @ (curve - there[:, :3, 3]).unsqueeze(-1)
        assert float(off[:, :2].norm(dim=1).max()) < 5e-4
