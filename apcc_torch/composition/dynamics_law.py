"""What a plant's parameters are to a controller that has a model of the dynamics."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.run_settings import ForcedRunSettings
from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.controller import APCCController
from apcc_torch.control.lookahead_refusal import LookaheadRefusal
from apcc_torch.model.dynamics_regressor import PARAMETERS
from apcc_torch.part import part_of


def with_dynamics(build: Builder, controller: APCCController) -> APCCController | CompositeController:
    """The controller as it is, or with the feed-forward that `dynamics_law` asks for.

    Raises:
        ConfigError: The model is none of constant-curvature sections, or there is a look ahead too.
        ValueRangeError: A setting is out of range.
    """
    config = build.config
    assert isinstance(config, ForcedRunSettings)  # the only runs with a law of the dynamics
    if config.dynamics_law is None:
        return controller
    LookaheadRefusal.DYNAMICS_LAW.check(config.lookahead is not None)
    composite: CompositeController = part_of(config.dynamics_law)(controller, None, None, config.dynamics_law)
    return build.placed(composite)


def true_parameters(build: Builder, payload: Tensor) -> Tensor:
    """theta of the plant (..., R, 5); not a number for its rigidities where they differ from section to section.

    Args:
        build: Of the run.
        payload: (..., R) kg.
    """
    arm = build.true_arm
    series = 1.0 if arm.stiffness_rule == "series" else float("nan")
    reference = arm.stiffness_reference
    values = {
        "bending_rigidity": series * reference * arm.bending_stiffness,
        "axial_rigidity": series * reference * arm.axial_stiffness,
        "tendon_damping": build.config.plant.tendon_damping,
        "payload": payload,
        "mass": arm.mass,
    }
    columns = [torch.as_tensor(values[name]).to(payload).expand(payload.shape) for name in PARAMETERS]
    return torch.stack(columns, dim=-1)
