"""True arms and their motion under tendons that are drawn."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apcc_torch.control.pid import ramp
from apcc_torch.model.arm import Arm
from apcc_torch.simulation.plant import Plant, PlantSettings
from apcc_torch.simulation.plant_state import PlantState

D = torch.float64
ARM = Arm(lengths=[0.2, 0.25], mass=0.4)


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=D)


def plant(payload: Tensor, kind: type[Plant] = Plant, arm: Arm = ARM, **changes: Any) -> Plant:
    settings = {"refine": 1, "tendon_damping": 20.0, **changes}
    for name in ("events", "places"):
        if name in settings:
            settings[name] = getattr(PlantSettings(), name).changed(**settings[name])
    return kind.on(arm, payload, kind.settings_type(**settings))


def run(arm: Plant, y_d: Tensor, steps: int, dt: float, now: PlantState | None = None) -> PlantState:
    """The arm after steps on a straight line from zero to y_d, at which its references then stay."""
    now = arm.straight(arm.payload.shape) if now is None else now
    for k in range(1, steps + 1):
        now = arm.advance(now, ramp(torch.zeros_like(y_d), y_d, k / steps, steps * dt), dt, k)
    return now


def tip(arm: Plant, now: PlantState) -> Tensor:
    return arm.backbone.tip(now.arm.q, arm.dynamics.lengths)
