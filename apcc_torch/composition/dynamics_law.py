"""The setting `dynamics_law` to a controller that has a model of the dynamics."""

from __future__ import annotations

import torch
from torch import Tensor

from apcc_torch.composition.build import Builder
from apcc_torch.composition.choice import choice
from apcc_torch.composition.schema import DynamicsLawConfig
from apcc_torch.control.adaptive_dynamics import AdaptiveDynamics
from apcc_torch.control.composite_controller import CompositeController
from apcc_torch.control.controller import APCCController
from apcc_torch.errors import ConfigError
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.dynamics_regressor import PARAMETERS, DynamicsRegressor

LAWS = ("none", "feedforward", "composite")


def dynamics_law(build: Builder, c: DynamicsLawConfig) -> AdaptiveDynamics:
    """The law of theta; of a feed-forward one that moves nothing."""
    composite = c.kind == "composite"
    nominal = build.vector("dynamics_law", [getattr(c, name) for name in PARAMETERS])
    deviation = build.vector("dynamics_law", [getattr(c, f"{name}_deviation") for name in PARAMETERS])
    bounds = {}
    for name in ("lower", "upper"):
        values = getattr(c, name)
        bounds[name] = None if values is None else build.vector(f"dynamics_law.{name}", values, len(PARAMETERS))
    return AdaptiveDynamics(
        nominal,
        deviation if composite else torch.zeros_like(deviation),
        **bounds,
        tracking_gain=c.tracking_gain if composite else 0.0,
        prediction=c.prediction and composite,
        filter_time=c.filter_time,
        memory=c.memory,
        torque_noise=c.torque_noise,
        length=c.length,
        dead_zone=c.dead_zone,
    )


def with_dynamics(build: Builder, controller: APCCController) -> APCCController | CompositeController:
    """The controller as it is, or with the feed-forward that `dynamics_law` asks for.

    Raises:
        ConfigError: The law is unknown, or the model is none of constant-curvature sections.
        ValueRangeError: A setting is out of range.
    """
    c = build.config.dynamics_law
    if choice("dynamics_law.kind", c.kind, LAWS) == "none":
        return controller
    if not isinstance(controller.backbone, PCCBackbone):
        raise ConfigError(f"dynamics_law={c.kind} needs model=pcc, got {build.config.model.kind}")
    regressor = DynamicsRegressor(build.routing(), build.base_rotation(), c.damping_ratio)
    return CompositeController(
        controller,
        regressor,
        dynamics_law(build, c),
        stiffness=c.stiffness,
        damping=c.damping,
        reference_time=c.reference_time,
        force_limit=c.force_limit,
    )


def true_parameters(build: Builder, payload: Tensor) -> Tensor:
    """theta of the plant (..., R, 5); not a number for its rigidities where they differ from section to section.

    Args:
        build: Of the run.
        payload: (..., R) kg.
    """
    p = build.config.plant
    series = 1.0 if p.stiffness_rule == "series" else float("nan")
    reference = p.stiffness_reference
    found = {
        "bending_rigidity": series * reference * p.bending_stiffness,
        "axial_rigidity": series * reference * p.axial_stiffness,
        "tendon_damping": p.tendon_damping,
        "payload": payload,
        "mass": p.mass,
    }
    columns = [torch.as_tensor(found[name]).to(payload).expand(payload.shape) for name in PARAMETERS]
    return torch.stack(columns, dim=-1)
