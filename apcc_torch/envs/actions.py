"""What an action means: most modes turn numbers in [-1, 1] into the next desired configuration of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.model.arm import Arm
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.part import Part
from apcc_torch.settings import OURS, Settings, resolved, setting

ACTIONS = ("configuration_velocity", "task_velocity", "tendon_lengths", "pressures", "adaptation")

MOST_ELONGATION = 0.8
"""No section changes its length by more than this share of the shortest one's, whatever its bound in metres."""


@dataclass(frozen=True, kw_only=True)
class ActionSettings(Settings):
    """What an action of 1 is worth, and what no action exceeds; settings of `Drive`."""

    action: str = setting("configuration_velocity", "", OURS, "what an action means", choices=ACTIONS)
    bend_rate: float = setting(3.0, "rad/s", OURS, "largest rate of a bend of q_d", above=0)
    length_rate: float = setting(0.1, "m/s", OURS, "largest rate of an elongation of q_d", above=0)
    bend_bound: float = setting(3.0, "rad", OURS, "largest bend of q_d", above=0)
    elongation_bound: float = setting(
        0.08, "m", OURS, "largest elongation of q_d; at most 0.8 of the shortest section", above=0
    )
    speed: float = setting(0.5, "m/s", OURS, "task_velocity: speed of the tip along an axis", above=0)
    task_damping: float = setting(1e-2, "m/rad", OURS, "task_velocity: damping of the pseudo-inverse", least=0)
    task_null_gain: float = setting(0.05, "m/s", OURS, "task_velocity: weight of the elongation cost Psi", least=0)
    tendon_range: float = setting(0.05, "m", OURS, "tendon_lengths: change of a tendon's length", above=0)
    decades: float = setting(1.0, "", OURS, "adaptation: powers of ten by which an action scales the gain", least=0)

    def elongation(self, arm: Arm) -> float:
        """The largest elongation on this arm, m."""
        return min(self.elongation_bound, MOST_ELONGATION * float(arm.rest_lengths().min()))

    def size(self, arm: Arm) -> int:
        """How many numbers an action has."""
        n_b = arm.n_sections
        n_a = arm.n_tendons
        sizes = {"task_velocity": 3, "tendon_lengths": n_a, "pressures": n_a, "adaptation": n_b}
        return sizes.get(self.action, 3 * n_b)


class Drive(Part):
    """The modes without a controller: q_d moves with bounded rates and stays within its bounds.

    configuration_velocity: the rates themselves.
    task_velocity: a velocity of the tip, by the damped pseudo-inverse of the nominal model at q_d, Eq. (16).
    tendon_lengths: wanted length changes, to which q_d moves as fast as its rates allow; of several q_d the smallest.

    Args:
        arm: The arm.
        period: Control period, s.
        like: Dtype and device.
        *settings, **changes: See `ActionSettings`; any action but "adaptation" and "pressures".
    """

    settings_type = ActionSettings

    rates: Tensor
    bounds: Tensor
    lengths: Tensor
    to_configuration: Tensor
    action: str
    speed: float
    tendon_range: float

    def __init__(self, arm: Arm, period: float, like: Tensor, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(ActionSettings, settings, changes)
        self.hold(s)
        self.period = period
        lengths = arm.rest_lengths().to(like)
        self.backbone = PCCBackbone(arm.n_sections, arm.base_rotation().to(like))
        self.inverse_kinematics = InverseKinematics(
            1.0,
            damping=s.task_damping,
            null_gain=s.task_null_gain,
            bend_rate=s.bend_rate,
            length_rate=s.length_rate,
        ).to(like)
        rates = (s.bend_rate, s.bend_rate, s.length_rate)
        bounds = (s.bend_bound, s.bend_bound, s.elongation(arm))
        self.register_buffer("rates", like.new_tensor(rates * arm.n_sections))
        self.register_buffer("bounds", like.new_tensor(bounds * arm.n_sections))
        self.register_buffer("lengths", lengths)
        self.register_buffer("to_configuration", torch.linalg.pinv(arm.routing().to(like).matrix(lengths)))

    def forward(self, q_d: Tensor, action: Tensor) -> Tensor:
        """The desired configuration (N, 3 n_b) after one control period.

        Args:
            q_d: (N, 3 n_b) before it.
            action: (N, a) in [-1, 1].
        """
        if self.action == "configuration_velocity":
            step = self.period * self.rates * action
        elif self.action == "task_velocity":
            tip, J = self.backbone.tip_and_jacobian(q_d, self.lengths)
            step = self.period * self.inverse_kinematics(J, torch.zeros_like(tip), self.speed * action, q_d)
        else:
            # y = B^T q, so q^T = y^T B^+.
            goal = self.within(self.tendon_range * action @ self.to_configuration)
            reach = self.period * self.rates
            step = (goal - q_d).clamp(-reach, reach)
        return self.within(q_d + step)

    def within(self, q_d: Tensor) -> Tensor:
        """q_d (N, 3 n_b) held to its bounds; what is not a number stays so."""
        return q_d.clamp(-self.bounds, self.bounds)
