"""The controller's step as machine code with every kinematic model."""

from __future__ import annotations

import pytest
import torch

from apcc_torch import AdaptiveLaw, APCCController, InverseKinematics, Measurement, SavitzkyGolay, StateFeedback, Target
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.affine import AffineBackbone
from apcc_torch.model.tendons import rack_routing
from apcc_torch.native.function import NativeFunction
from apcc_torch.native.structure import flattened
from arms import HANGING_BASE, PI
from kinematic_models import MODELS, shapes_of
from laws import generator

D = torch.float64
X = torch.tensor([0.1, 0.355, 0.59], dtype=D)


@pytest.mark.parametrize(
    ("name", "law"), [("torsion", "estimator_aware"), ("mixed", "partial"), ("affine", "estimator_aware")]
)
def test_the_controllers_step_equals_its_eager_self(name: str, law: str) -> None:
    # One rod a section builds fastest, and goes the same way as more.
    model = AffineBackbone(3, HANGING_BASE, rods=1) if name == "affine" else MODELS[name](3, HANGING_BASE)
    feedback = StateFeedback(model, X, max_iterations=2, damping=1e-4)
    c = APCCController(
        model,
        feedback,
        SavitzkyGolay(5, 2),
        InverseKinematics(
            1.5,
            null_gain=0.2,
            coordinates=model.coordinates,
            bend_rate=3.0,
            length_rate=0.5,
            null_weights=2.0 * PI,
            null_bends=0.2 * PI,
            null_step=0.1,
            null_speed=5e-3,
        ),
        AdaptiveLaw(3, 1.0, regressor=law),
        routing=rack_routing(X),
        elongation_bound=0.08,
        bend_bound=3.0,
    )
    q = shapes_of(model, (), D, generator(3), angle=0.4)
    lengths = 1.02 * PI
    state = c.initial_state(torch.zeros_like(q), PI, torch.zeros((), dtype=D))
    target = Target(torch.tensor([0.1, 0.1, -0.5], dtype=D), torch.zeros(3, dtype=D))
    poses = model.pose(q, lengths, *decouple(X, lengths))
    with torch.no_grad():
        step = NativeFunction(c, (state, Measurement(poses, torch.zeros((), dtype=D)), target))
        for k in range(3):
            T = model.pose((0.8 + 0.1 * k) * q, lengths, *decouple(X, lengths))
            measurement = Measurement(T, torch.tensor(0.01 * k, dtype=D))
            want = c(state, measurement, target)
            have = step(state, measurement, target)
            for a, b in zip(flattened(have), flattened(want), strict=True):
                scale = b.double().abs().max().clamp(min=1.0)
                assert float((a.double() - b.double()).abs().max() / scale) < 1e-9
            state = want[0]
