"""The small arm of `parts` with chambers in place of tendons."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apcc_torch.control.pressure import PressureControl
from apcc_torch.model.chambers import ChamberForce, Chambers
from apcc_torch.model.coordinates import CONSTANT_CURVATURE
from parts import lengths, number, numbers, some

B = Chambers(offsets=0.015).routing(lengths()).matrix(lengths())

GROUPS = torch.eye(2).repeat_interleave(3, dim=-1).to(lengths())


def chambered() -> Tensor:
    """B (6, 6) of three chambers in each of its sections."""
    return B.clone().to(lengths())


def pushing() -> ChamberForce:
    """What its chambers do."""
    area = numbers(2.0, 2.1, 2.2, 1.5, 1.6, 1.7) * 1e-4
    return ChamberForce(area, 1e-6 + 0.0 * area, 2e4 + 0.0 * area, 0.0 * area, 1e5 + 0.0 * area)


def together() -> Tensor:
    """(2, 6) which chambers are of one section."""
    return GROUPS.clone().to(lengths())


def pressed(of: PressureControl) -> Any:
    """Two steps of its loop, the second with some chambers at their limits."""
    y, y_d = some(6, scale=1e-3), some(6, seed=1, scale=1e-2)
    state, first = of(of.initial_state(0.0 * y), y_d, y, number(0.02))
    state, second = of(state, 3.0 * y_d, 0.5 * y, number(0.02))
    return first, second, state.z, state.excess, *of.bounds(state, CONSTANT_CURVATURE)[:2]
