"""Parameters that ask for a gradient keep their graph when a module takes them in."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from apcc_torch.control.adaptation import AdaptiveLaw
from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.control.length_bounds import LengthBounds
from apcc_torch.estimation.state_feedback import StateFeedback
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.model.tendons import rack_routing
from arms import HANGING_BASE, PI

END = PI.cumsum(0)
FEEDBACK = StateFeedback(PCCBackbone(3), END)
POSES = PCCBackbone(3, HANGING_BASE).pose(torch.full((9,), 0.1).double(), PI, *decouple(END, PI))

TAKEN: dict[str, tuple[Tensor, Callable[[Tensor], Tensor]]] = {
    "gain, a number": (torch.tensor(2.0), lambda x: InverseKinematics(x).K),
    "gain, a diagonal": (PI, lambda x: InverseKinematics(x).K),
    "gain, a matrix": (torch.eye(3), lambda x: AdaptiveLaw(3, x).metric),
    "weights": (PI, lambda x: InverseKinematics(null_weights=x).descent(torch.full((9,), 0.01).double())),
    "reach": (END, lambda x: LengthBounds(PI, x, lower=None, upper=None, reach="each")(0.9 * PI)),
    "bounds' nominal": (PI, lambda x: LengthBounds(x, lower=1.1, reach="free")(PI.clone())),
    "bounds' shares": (torch.full((3,), 1.1).double(), lambda x: LengthBounds(PI, lower=x, reach="free")(PI.clone())),
    "base_rotation": (HANGING_BASE, lambda x: PCCBackbone(3, x).tip(torch.full((9,), 0.1).double(), PI)),
    "abscissae": (END, lambda x: StateFeedback(PCCBackbone(3), x).abscissae),
    "tendon offset": (torch.tensor(0.027).double(), lambda x: rack_routing(END, x).matrix(PI)),
}


@pytest.mark.parametrize("name", TAKEN)
def test_graph_is_kept(name: str) -> None:
    value, use = TAKEN[name]
    leaf = value.clone().requires_grad_()
    (slope,) = torch.autograd.grad(use(leaf).sum(), leaf)
    assert float(slope.abs().max()) > 0.0
    # What it holds is its own: the caller's tensor may change.
    plain = value.clone()
    held = use(plain)
    was = held.clone()
    plain.zero_()
    assert torch.equal(held, was)
