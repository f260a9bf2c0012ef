"""Arms at rest under tendons and loads, from the equilibria of `model.statics`, and the balance that judges them."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from apcc_torch import SoftArmDynamics, StateFeedback
from apcc_torch.estimation.external_force import ForceBalance
from apcc_torch.estimation.posture import Posture
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.loads import Loads
from apcc_torch.model.static_body import StaticBody
from apcc_torch.model.statics import equilibrium
from apcc_torch.model.stiffness import scaled_stiffness
from apcc_torch.model.tendons import rack_routing
from arms import HANGING_BASE, PI
from laws import generator, uniform

D = torch.float64
RACKS = torch.tensor([0.105, 0.36, 0.60], dtype=D)
ROUTING = rack_routing(RACKS)
MATERIAL = (1.0 / 0.6, 10.0, 0.0778)
"""Section V-B's arm: kg/m, N, N m^2."""


def arm(lengths: Tensor = PI, damping_ratio: float = 0.0) -> SoftArmDynamics:
    """Section V-B's arm in sections of these lengths."""
    axial, bending = scaled_stiffness(lengths)
    return SoftArmDynamics(
        lengths, lengths / 0.6, axial, bending, damping_ratio=damping_ratio, base_rotation=HANGING_BASE
    )


class Resting(NamedTuple):
    """R arms: q (R, n), forces u (R, 9) N, tendon length changes y (R, 9) m, sensor poses T (R, 3, 4, 4)."""

    q: Tensor
    u: Tensor
    y: Tensor
    T: Tensor


def at_rest(
    rows: int, payload: Tensor | None = None, lengths: Tensor = PI, section: int = -1, force: Tensor | None = None
) -> Resting:
    """Arms held by tendons of random lengths, with a payload or a force (R, 3) at a section's tip."""
    dynamics = arm(lengths)
    n_b = len(lengths)
    held = uniform((rows, 9), -0.012, 0.008, D, generator(7))
    wrenches = None
    if force is not None:
        wrenches = torch.zeros(rows, n_b, 6, dtype=D)
        wrenches[:, section, 3:] = force
    found = equilibrium(
        dynamics, routing=ROUTING, tendon_lengths=held, payload=payload, loads=Loads(section_wrenches=wrenches),
        tolerance=1e-11,
    )  # fmt: skip
    assert bool(found.converged.all()) and found.u is not None
    T = PCCBackbone(n_b, HANGING_BASE).pose(found.q, lengths, *decouple(RACKS, lengths))
    return Resting(found.q, found.u, held, T)


def balance(backbone: Any = None, **settings: Any) -> ForceBalance:
    """The balance of forces on three sections, constant curvature where no model is given."""
    model = PCCBackbone(3, HANGING_BASE) if backbone is None else backbone
    feedback = StateFeedback(model, RACKS, angular_weight=0.03, max_iterations=60)
    return ForceBalance(StaticBody(model, *MATERIAL), ROUTING, feedback, **settings)


def posture(found: Resting) -> Posture:
    """The arm's own configuration and forces, as if seen without error."""
    return Posture(found.q, PI.expand(len(found.q), 3), found.u)
