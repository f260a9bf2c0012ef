"""What an action means: each mode turns numbers in [-1, 1] into the next desired configuration of the model."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from apcc_torch.control.inverse_kinematics import InverseKinematics
from apcc_torch.envs.arm import Arm
from apcc_torch.errors import ConfigError
from apcc_torch.model.backbone import PCCBackbone

ACTIONS = ("configuration_velocity", "task_velocity", "tendon_lengths", "adaptation")


@dataclass(frozen=True)
class Limits:
    """What an action of 1 is worth, and what no action exceeds.

    bend_rate, length_rate: Rates of q_d, rad/s and m/s.
    bend_bound, elongation_bound: Magnitudes of q_d, rad and m.
    speed: Of the tip, per axis, m/s.
    tendon_range: Change of a tendon's length, m.
    decades: Powers of ten by which an action scales an adaptation gain.
    """

    bend_rate: float = 3.0
    length_rate: float = 0.1
    bend_bound: float = 3.0
    elongation_bound: float = 0.08
    speed: float = 0.5
    tendon_range: float = 0.05
    decades: float = 1.0


def check_action(name: str) -> str:
    """`name` if it is one of `ACTIONS`.

    Raises:
        ConfigError: It is not.
    """
    if name not in ACTIONS:
        raise ConfigError(f"action must be one of {', '.join(ACTIONS)}, got {name!r}")
    return name


def action_size(name: str, arm: Arm) -> int:
    """How many numbers an action has."""
    n_b = arm.n_sections
    return {"configuration_velocity": 3 * n_b, "task_velocity": 3, "tendon_lengths": arm.n_tendons, "adaptation": n_b}[
        name
    ]


class Drive(nn.Module):
    """The modes without a controller: q_d moves with bounded rates and stays within its bounds.

    configuration_velocity: the rates themselves.
    task_velocity: a velocity of the tip, by the damped pseudo-inverse of the nominal model at q_d, Eq. (16).
    tendon_lengths: wanted length changes, to which q_d moves as fast as its rates allow; nine tendons name one q_d.

    Args:
        mode: One of `ACTIONS` but "adaptation".
        arm: The arm.
        limits: The bounds.
        period: Control period, s.
        like: Dtype and device.
    """

    rates: Tensor
    bounds: Tensor
    lengths: Tensor
    to_configuration: Tensor

    def __init__(self, mode: str, arm: Arm, limits: Limits, period: float, like: Tensor) -> None:
        super().__init__()
        n_b = arm.n_sections
        self.mode, self.limits, self.period = mode, limits, period
        self.backbone = PCCBackbone(n_b, arm.base(like))
        self.inverse_kinematics = InverseKinematics(
            1.0, damping=1e-2, null_gain=0.05, bend_rate=limits.bend_rate, length_rate=limits.length_rate
        ).to(like)
        rates = (limits.bend_rate, limits.bend_rate, limits.length_rate)
        bounds = (limits.bend_bound, limits.bend_bound, limits.elongation_bound)
        lengths = arm.lengths(like)
        self.register_buffer("rates", like.new_tensor(rates * n_b))
        self.register_buffer("bounds", like.new_tensor(bounds * n_b))
        self.register_buffer("lengths", lengths)
        self.register_buffer("to_configuration", torch.linalg.inv(arm.routing(like).matrix(lengths)))

    def forward(self, q_d: Tensor, action: Tensor) -> Tensor:
        """The desired configuration (N, 9) after one control period.

        Args:
            q_d: (N, 9) before it.
            action: (N, a) in [-1, 1].
        """
        if self.mode == "configuration_velocity":
            step = self.period * self.rates * action
        elif self.mode == "task_velocity":
            tip, J = self.backbone.tip_and_jacobian(q_d, self.lengths)
            step = self.period * self.inverse_kinematics(J, torch.zeros_like(tip), self.limits.speed * action, q_d)
        else:
            # y = B^T q, so q^T = y^T B^-1.
            goal = self.within(self.limits.tendon_range * action @ self.to_configuration)
            reach = self.period * self.rates
            step = (goal - q_d).clamp(-reach, reach)
        return self.within(q_d + step)

    def within(self, q_d: Tensor) -> Tensor:
        """q_d (N, 9) held to its bounds; what is not a number stays so."""
        return q_d.clamp(-self.bounds, self.bounds)
