"""What one estimate of one arm costs: eager, with the covariance kept, and as machine code."""

from __future__ import annotations

import torch
from force_cases import CONTROLLERS, Seen, affine, balance, settings
from timing import timed_steps
from torch import Tensor, nn

from apcc_torch.composition.build import Builder
from apcc_torch.estimation.contact import ContactSearch
from apcc_torch.estimation.external_force import ForceBalance
from apcc_torch.estimation.posture import Posture
from apcc_torch.native.function import NativeFunction


class Weighing(nn.Module):
    """A payload's estimate whose covariance of the balance is kept from before."""

    def __init__(self, b: ForceBalance) -> None:
        super().__init__()
        self.balance = b

    def forward(self, q_bar: Tensor, pi_hat: Tensor, u: Tensor, covariance: Tensor) -> tuple[Tensor, ...]:
        """The estimate's fields."""
        return tuple(self.balance.payload(Posture(q_bar, pi_hat, u), covariance=covariance))


def costs(seen: Seen) -> dict[str, float]:
    """Microseconds that a tenth of the calls stay below, for a busy machine shows least in them."""
    build = Builder(settings(*CONTROLLERS["fixed"]))
    b, slopes = balance(build, build.backbone()), balance(build, affine(build))
    p = Posture(seen.q_bar[0], seen.pi_hat[0], seen.u[0])
    bent = Posture(torch.zeros(15, dtype=p.q_bar.dtype), p.pi_hat, p.u)
    weighing = Weighing(b)
    kept = (*p[:3], b.covariance(p))
    timed = {
        "payload, constant curvature": (b.payload, (p,), 200),
        "payload, affine curvature": (slopes.payload, (bent,), 100),
        "payload, constant curvature, covariance kept": (weighing, kept, 400),
        "the same, compiled": (NativeFunction(weighing, kept), kept, 5000),
        "contact search, constant curvature": (ContactSearch(b), (p,), 50),
    }
    return {name: timed_steps(step, [given], count)["p10_us"] for name, (step, given, count) in timed.items()}
