"""An arm as it is seen, and what its tendons do then: told forces, or elastic tendons that go slack and rub."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from apcc_torch.model.arm import Arm
from apcc_torch.model.friction import elastic_tension, tension_share
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.part import Part, hold_rows
from apcc_torch.settings import aligned
from apcc_torch.shapes import check_finite, check_positive, check_tensor
from apcc_torch.spread import spread


class Posture(NamedTuple):
    """An arm as it is seen.

    q_bar: (..., n) inferred configuration. pi_hat: (..., n_b) rest lengths, m.
    u: (..., n_a) forces conjugate to tendon length, N (tension is -u); None: nobody measures them.
    qdot: (..., n) configuration velocity, for the forces of damping, taken as exact; None at rest.
    payload: (...) known tip mass, kg; None for none.
    pulled: (..., n_a) length that each tendon's motor has taken in, with the stretch at the start, m, as
        `Actuation.pulled` has it: where `u` is None, the force of elastic tendons follows.
    slide: (..., n_a) direction that each tendon last moved in, +1 taken in, -1 paid out; None: no friction.

    Example:
        >>> Posture(q_bar=torch.zeros(6), pi_hat=torch.tensor([0.2, 0.25]), u=torch.zeros(6)).double().q_bar.dtype
        torch.float64
    """

    q_bar: Tensor
    pi_hat: Tensor
    u: Tensor | None
    qdot: Tensor | None = None
    payload: Tensor | None = None
    pulled: Tensor | None = None
    slide: Tensor | None = None

    def double(self) -> Posture:
        """The posture in double precision."""
        rest = (None if part is None else part.double() for part in self[2:])
        return Posture(self.q_bar.double(), self.pi_hat.double(), *rest)


class TendonMechanics(Part):
    """Tendons that stretch, go slack and rub along their way, as an identification finds them.

    Args:
        stiffness: (..., n_a) N/m.
        friction: (...) capstan coefficient.

    Raises:
        ValueRangeError: A stiffness is not positive, or the friction is not finite.

    Example:
        >>> from apcc_torch.model.arm_tendons import Actuation
        >>> tendons = TendonMechanics.of(Arm(lengths=[0.2], actuation=Actuation(stiffness=2000.0, friction=0.1)))
        >>> tendons.forces(torch.tensor([0.003, 0.0, 0.0]), torch.tensor([0.0, 0.001, -0.001])).round(decimals=2) + 0.0
        tensor([-6., -2.,  0.])
    """

    stiffness: Tensor
    friction: Tensor

    def __init__(self, stiffness: Tensor, friction: Tensor) -> None:
        super().__init__()
        check_positive("stiffness", check_tensor("stiffness", stiffness, (None,)))
        check_finite("friction", check_tensor("friction", friction, ()))
        hold_rows(self, stiffness=(stiffness, 1), friction=(friction, 0))

    @staticmethod
    def of(arm: Arm) -> TendonMechanics:
        """Those of an arm's file."""
        stiffness = spread("actuation.stiffness", arm.actuation.stiffness, arm.n_tendons)
        return TendonMechanics(stiffness, torch.tensor(arm.actuation.friction, dtype=stiffness.dtype))

    def forces(self, pulled: Tensor, y: Tensor) -> Tensor:
        """Forces conjugate to tendon length u (..., n_a), N, never pushing.

        Args:
            pulled: (..., n_a) as in `Posture`, m.
            y: (..., n_a) change of the tendons' length in the arm, m.
        """
        return -elastic_tension(pulled + y, self.stiffness.to(y))

    def rubbed(self, B: Tensor, routing: TendonRouting, q: Tensor, lengths: Tensor, slide: Tensor) -> Tensor:
        """B (..., n, n_a) with what friction leaves of a tendon's force on its way to each section.

        Args:
            B: (..., n, n_a) without friction.
            routing: The tendons.
            q: (..., n), of which each section's first two are its bends, rad.
            lengths: (..., n_b) rest lengths, m.
            slide: (..., n_a) as in `Posture`.
        """
        fractions = routing.fractions(lengths.to(routing.anchors)).to(q)
        share = tension_share(fractions, q, aligned(self.friction.to(q), 1) * slide)
        rows = B.unflatten(-2, (fractions.shape[-2], -1)) * share.unsqueeze(-2)
        return rows.flatten(-3, -2)
