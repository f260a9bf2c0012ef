"""The A-PCC controller with more to do than bring the tip somewhere: further tasks, clearance, tendon limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from apcc_torch.control.asked import Asked
from apcc_torch.control.clearance import ClearanceCost
from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.control.task_stack import TaskStack
from apcc_torch.control.tasks import Task, TaskTarget
from apcc_torch.control.tendon_limits import ConstrainedVelocity, TendonLimits
from apcc_torch.errors import ConfigError
from apcc_torch.lie import se3
from apcc_torch.modes import values_of

SAME_PLACE = 1e-6
"""How near a sensor must be to a task's point to measure it, m."""


class TaskController(APCCController):
    """`APCCController` whose velocity comes from a stack of tasks. Remarks 1 and 2 [Dalenberg].

    The first task is the paper's: the tip's position, with the K and the damping of `inverse_kinematics`, at level 0.
    Further ones stand beside it (level 0), below (1, 2, …) or above it (-1, …); `Target.tasks` says what they should
    reach. A task's point is measured where a sensor sits at its abscissa, the tip by the last sensor; elsewhere, and
    where the sensor does not count, the model's pose is taken. The law keeps learning from the tip's position alone:
    the regressor of an orientation is zero.

    Args:
        *parts: As in `APCCController`.
        tasks: The further tasks.
        clearance: What the arm keeps clear of in the null space of all tasks, besides Psi; None for nothing.
        tendon_limits: Lengths and speeds of the tendons that no command may leave; None for none. They need `routing`
            and daqp, and all tasks at one level: a limited velocity weighs them, it does not rank them.
        **settings: As in `APCCController`.

    Raises:
        ConfigError: tendon_limits has no routing, or stands with several levels.
    """

    tendon_limits: TendonLimits | None

    def __init__(
        self,
        *parts: Any,
        tasks: Sequence[Task] = (),
        clearance: ClearanceCost | None = None,
        tendon_limits: TendonLimits | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(*parts, **settings)
        solver = self.inverse_kinematics
        self.stack = TaskStack([Task("position", gain=solver.K), *tasks], solver.damping)
        self.clearance = clearance
        self.tendon_limits = tendon_limits
        self.constrained: ConstrainedVelocity | None = None
        if tendon_limits is not None:
            if self.routing is None:
                raise ConfigError("tendon_limits needs a routing")
            if len(self.stack.levels) > 1:
                raise ConfigError("tendon_limits needs all tasks at level 0: it weighs them, it does not rank them")
            self.constrained = ConstrainedVelocity(solver.damping)
        self.sensors = [_sensor(task, self.feedback.abscissae) for task in tasks]

    def forward(
        self, state: ControllerState, measurement: Measurement, target: Target
    ) -> tuple[ControllerState, Command]:
        """One control step; see `APCCController.forward`. A command never leaves the tendons' limits of length."""
        later, command = super().forward(state, measurement, target)
        if self.tendon_limits is None or command.y is None:
            return later, command
        # What the program cannot see, a law that changes B and the bounds of q_d, is cut here.
        return later, command._replace(y=self.tendon_limits.held(command.y))

    def _solve(self, asked: Asked) -> tuple[Tensor, Tensor | None]:
        """qdot (..., n) of the whole stack within its bounds, and the tendons' `Command.limits`."""
        state, measurement, target, q, pi_hat, _, e, dt, bounds = asked
        T, J_b = self.stack.poses(self.backbone, q, pi_hat)
        # The tip's error is the controller's, which knows whether the tip was measured.
        turn = torch.eye(3, dtype=e.dtype, device=e.device).expand(*e.shape[:-1], 3, 3)
        seen = [se3.pose(turn, target.x_d - e)]
        seen += [_measured(measurement, i, T[..., k + 1, :, :]) for k, i in enumerate(self.sensors)]
        targets = (TaskTarget(target.x_d, target.xdot_d), *(target.tasks or ()))
        driven = self.backbone.coordinates.driven
        rates = self.stack.asked(T, driven(J_b), targets, seen)
        velocity = self.inverse_kinematics.tip_velocity(e, target.xdot_d)
        descent = self.inverse_kinematics.descent(q, dt, velocity)
        if self.clearance is not None:
            descent = descent + driven(self.clearance.descent(self.backbone, q, pi_hat))
        if self.constrained is None:
            return self.inverse_kinematics.bounded(self.stack(rates, descent, bounds)), None
        assert self.tendon_limits is not None and self.routing is not None  # checked when this was made
        B = self.backbone.tendon_matrix(self.routing, pi_hat)
        y = (B.mT @ state.q_d.unsqueeze(-1)).squeeze(-1)
        lower, upper = self.tendon_limits.rates(y, dt)
        if bounds is not None:  # of linear forms of qdot, each coordinate being one
            B = torch.cat((B, torch.eye(B.shape[-2], dtype=B.dtype, device=B.device).expand(*B.shape[:-1], -1)), dim=-1)
            ends = zip((lower, upper), (bounds.lower, bounds.upper), strict=True)
            lower, upper = (torch.cat((a.expand(*b.shape[:-1], -1), b), dim=-1) for a, b in ends)
        qdot, status = self.constrained(rates, B, lower, upper, descent)
        return self.inverse_kinematics.bounded(qdot), status


def _sensor(task: Task, abscissae: Tensor) -> int | None:
    """The index of the sensor that measures the task's point; None where there is none."""
    if task.abscissa is None:
        return len(abscissae) - 1
    near = (abscissae - task.abscissa).abs() < SAME_PLACE
    return values_of(near.nonzero()[0, 0]) if values_of(near.any()) else None


def _measured(measurement: Measurement, sensor: int | None, T: Tensor) -> Tensor:
    """The pose (..., 4, 4) that a sensor measured; the model's T where it does not count or is not finite."""
    if sensor is None:
        return T
    seen = measurement.T[..., sensor, :, :]
    good = torch.isfinite(seen).all(-1).all(-1)
    for mask in (measurement.mask, measurement.angular_mask):
        if mask is not None:
            good = good & mask[..., sensor]
    return torch.where(good[..., None, None], seen, T)
