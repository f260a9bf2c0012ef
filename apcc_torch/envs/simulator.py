"""The environments' physics as pure functions: a state and an action in, a state and what came of it out.

Nothing here asks for a value, so one step can be compiled whole and runs on any device; rows never meet.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from apcc_torch.control.step_io import ControllerState
from apcc_torch.envs.actions import Drive, Limits, action_size
from apcc_torch.envs.adaptation import AdaptiveLoop
from apcc_torch.envs.arm import Arm
from apcc_torch.envs.dynamic import DynamicArm, DynamicState
from apcc_torch.envs.kinematic import KinematicArm, KinematicState
from apcc_torch.envs.randomisation import Ranges, RowParameters
from apcc_torch.envs.rendering import Picture, picture
from apcc_torch.envs.row_trees import select
from apcc_torch.envs.sensing import Readings, Sensing
from apcc_torch.envs.streams import Stream
from apcc_torch.envs.tasks import DISTANCE, POSITION, SPEED, TASKS, Goal, Task
from apcc_torch.errors import ConfigError
from apcc_torch.model.backbone import PCCBackbone
from apcc_torch.part import check_settings

DYNAMICS = ("kinematic", "dynamic")
TENDON = 0.5
"""Bound of observed tendon length changes, m."""
EFFORT = 0.01
"""What an action of mean square 1 costs."""
MODEL_SCALE = 0.05
"""Error of the virtual model that costs 1 a step where the action adapts it, m."""
FARTHEST = 1e3
"""Largest magnitude of a coordinate or its rate before a row counts as diverged, as in `simulation`."""


class TruncatedReason(IntEnum):
    """Why a row was truncated."""

    NONE = 0
    TIME_LIMIT = 1
    NOT_FINITE = 2
    """The action or the arm's state is not a number: the row stays where it was."""
    DIVERGED = 3
    """The arm's state left its bounds: the row stays where it was."""


class Body(Protocol):
    """The true arms: `KinematicArm` or `DynamicArm`, each with its own state."""

    def lengths(self, rows: RowParameters) -> Tensor: ...
    def initial(self, rows: RowParameters) -> Any: ...
    def step(self, state: Any, y: Tensor, y_next: Tensor, q_d: Tensor, rows: RowParameters) -> Any: ...
    def points(self, state: Any, rows: RowParameters) -> Tensor: ...
    def tendons(self, state: Any) -> Tensor: ...
    def configuration(self, state: Any) -> Tensor: ...
    def coordinates(self, state: Any) -> tuple[Tensor, ...]: ...


class EnvState(NamedTuple):
    """Everything about N rows between two steps.

    rows: What was drawn at their resets. goal: The task's.
    arm: Of the kinematic or the dynamic arm. q_d: (N, 9), (N, n) of a controller with another model.
    y: (N, 9) tendon references, m.
    controller: Of the adaptive loop; None without one.
    readings: Of the sensors. stream: Their random numbers. step: (N,) int64 since the reset.
    """

    rows: RowParameters
    goal: Goal
    arm: KinematicState | DynamicState
    q_d: Tensor
    y: Tensor
    controller: ControllerState | None
    readings: Readings
    stream: Stream
    step: Tensor


class View(NamedTuple):
    """What a state looks like: observation (N, o) float32, and the task's error (N,) m."""

    observation: Tensor
    error: Tensor


class Outcome(NamedTuple):
    """What came of a step: the view after it, reward (N,) float32, truncated (N,) bool, reason (N,) int64."""

    view: View
    reward: Tensor
    truncated: Tensor
    reason: Tensor


@dataclass(frozen=True)
class Setup:
    """What is simulated.

    task: One of `TASKS`. action: One of `ACTIONS`. dynamics: "kinematic" or "dynamic".
    control_rate: Hz. substeps: Plant steps in a control period. max_episode_steps: None for no limit.
    ranges: Of what is drawn at resets. arm: The arm. limits: Of the actions.
    """

    task: str
    action: str
    dynamics: str
    control_rate: float
    substeps: int
    max_episode_steps: int | None
    ranges: Ranges
    arm: Arm
    limits: Limits

    def __post_init__(self) -> None:
        """Raises ConfigError or ValueRangeError where a setting has no meaning."""
        if self.task not in TASKS:
            raise ConfigError(f"task must be one of {', '.join(TASKS)}, got {self.task!r}")
        if self.dynamics not in DYNAMICS:
            raise ConfigError(f"dynamics must be one of {', '.join(DYNAMICS)}, got {self.dynamics!r}")
        if self.dynamics == "kinematic" and self.arm.model is not PCCBackbone:
            raise ConfigError("model must be PCCBackbone where the arm is kinematic: it follows q_d itself")
        check_settings(control_rate=self.control_rate, substeps=self.substeps, max_episode_steps=self.max_episode_steps)


class Simulator(nn.Module):
    """One task for any number of arms.

    Args:
        setup: What is simulated.
        like: Dtype of the physics, and device.
    """

    nominal: Tensor
    B: Tensor
    bounds: Tensor

    def __init__(self, setup: Setup, like: Tensor) -> None:
        super().__init__()
        self.setup = setup
        self.period = 1.0 / setup.control_rate
        arm, ranges = setup.arm, setup.ranges
        self.task: Task = TASKS[setup.task](arm, like)
        self.arm: Body
        if setup.dynamics == "kinematic":
            self.arm = KinematicArm(arm, like)
        else:
            varied = ranges.varies("lengths") or ranges.varies("stiffness")
            self.arm = DynamicArm(arm, self.period, setup.substeps, varied, like)
        adapts = setup.action == "adaptation"
        self.loop = AdaptiveLoop(arm, setup.limits, setup.dynamics, like) if adapts else None
        self.drive = None if adapts else Drive(setup.action, arm, setup.limits, self.period, like)
        self.sensing = Sensing(ranges.noise[1] > 0, int(ranges.delay[1]))
        self.action_size = action_size(setup.action, arm)
        self.register_buffer("nominal", arm.lengths(like))
        self.register_buffer("B", arm.routing(like).matrix(arm.lengths(like)))
        n_b = arm.n_sections
        bounds = [POSITION] * 3 * n_b + [SPEED] * 3 * n_b + [TENDON] * 2 * arm.n_tendons + self.task.bounds()
        if adapts:
            bounds += [POSITION] * n_b + [DISTANCE] * n_b
        self.register_buffer("bounds", torch.tensor(bounds, dtype=torch.float32, device=like.device))

    def initial(self, stream: Stream) -> EnvState:
        """Rows at the start of an episode: parameters and goal drawn, the arm hanging at rest."""
        stream, rows = self.setup.ranges.draw(stream, self.setup.arm.n_sections, self.nominal.dtype)
        lengths = self.nominal * rows.lengths
        stream, goal = self.task.draw(stream, lengths)
        arm = self.arm.initial(rows)
        points = self.arm.points(arm, rows)
        stream, readings = self.sensing.initial(_sensors(points).flatten(1), rows, stream)
        q_d, controller = torch.zeros_like(lengths).repeat_interleave(3, dim=-1), None
        y = q_d @ self.B
        if self.loop is not None:
            controller = self.loop.initial(readings.seen.unflatten(-1, (-1, 3)), rows.lengths, rows.estimate)
            q_d = controller.q_d
        return EnvState(rows, goal, arm, q_d, y, controller, readings, stream, torch.zeros_like(stream.drawn))

    def view(self, state: EnvState) -> View:
        """What the state looks like."""
        return self._view(state, self.arm.points(state.arm, state.rows))

    def forward(self, state: EnvState, action: Tensor) -> tuple[EnvState, Outcome]:
        """One control period.

        Args:
            state: From `initial` or the last step.
            action: (N, a); clipped to [-1, 1].
        """
        action = action.to(self.nominal.dtype).clamp(-1.0, 1.0)
        q_d, y, controller = self._command(state, action)
        arm = self.arm.step(state.arm, state.y, y, q_d, state.rows)
        # A row that goes wrong stays where it was: its observation is good, and its neighbours never notice.
        learnt = () if controller is None else (controller.q_bar, controller.pi_hat)
        largest = torch.cat((action, *self.arm.coordinates(arm), *learnt), dim=-1).abs().amax(-1)  # NaN stays NaN
        good = largest <= FARTHEST
        arm, q_d, y, controller = select(
            good, _Moved(arm, q_d, y, controller), _Moved(state.arm, state.q_d, state.y, state.controller)
        )
        points = self.arm.points(arm, state.rows)
        stream, readings = self.sensing.read(state.readings, _sensors(points).flatten(1), state.rows, state.stream)
        step = state.step + 1
        later = EnvState(state.rows, state.goal, arm, q_d, y, controller, readings, stream, step)
        view = self._view(later, points)
        reason = torch.where(torch.isfinite(largest), TruncatedReason.DIVERGED.value, TruncatedReason.NOT_FINITE.value)
        late = torch.zeros_like(step)
        if self.setup.max_episode_steps is not None:
            late = torch.where(step >= self.setup.max_episode_steps, TruncatedReason.TIME_LIMIT.value, late)
        reason = torch.where(good, late, reason)
        return later, Outcome(view, self._reward(later, action, view, points), reason > 0, reason)

    def picture(self, state: EnvState) -> Picture:
        """What a renderer draws of the one row of a state."""
        arm, setup, q = self.arm, self.setup, self.arm.configuration(state.arm)[0]
        time = self.period * state.step.to(q.dtype)
        view = self.view(state)
        goal = state.goal.points[0] if setup.task == "shape" else self.task.target(state.goal, time).x_d[0]
        text = f"t = {float(time):.2f} s, error {1e3 * float(view.error):.0f} mm"
        if setup.dynamics == "dynamic":
            text += f", payload {float(state.rows.payload):.2f} kg"
        racks = (self.nominal * state.rows.lengths[0]).cumsum(-1)
        routing = setup.arm.routing(q)
        return picture(q, arm.lengths(state.rows)[0], setup.arm.base(q), routing, racks, goal, text)

    def _command(self, state: EnvState, action: Tensor) -> tuple[Tensor, Tensor, ControllerState | None]:
        """The next q_d and tendon references (N, 9), and the controller's state."""
        if self.drive is not None:
            q_d = self.drive(state.q_d, action)
            return q_d, q_d @ self.B, None
        assert self.loop is not None and state.controller is not None  # one of the two drives
        time = self.period * state.step.to(action.dtype)
        # The first step integrates one period too: the state's stamp is one period before the first measurement.
        seen = state.readings.seen.unflatten(-1, (-1, 3))
        target = self.task.target(state.goal, time)
        controller, command = self.loop(state.controller, action, seen, time + self.period, target, state.rows.lengths)
        y = command.q_d @ self.B if command.y is None else command.y
        return command.q_d, y, controller

    def _view(self, state: EnvState, points: Tensor) -> View:
        """The view of a state whose points (N, 6, 3) m are known."""
        time = self.period * state.step.to(points.dtype)
        seen = state.readings.seen
        velocity = (seen - state.readings.before) / self.period
        sensors = seen.unflatten(-1, (-1, 3))
        tendons = self.arm.tendons(state.arm)
        parts = [seen, velocity, tendons, state.y, self.task.features(state.goal, time, sensors)]
        if state.controller is not None:
            assert self.loop is not None  # it made the state
            model = _sensors(self.loop.model_points(state.controller, state.rows.lengths))
            parts += [state.controller.pi_hat, (model - sensors).norm(dim=-1)]
        observation = torch.cat(parts, dim=-1).float()
        return View(observation.clamp(-self.bounds, self.bounds), self.task.error(state.goal, time, points))

    def _reward(self, state: EnvState, action: Tensor, view: View, points: Tensor) -> Tensor:
        cost = view.error / self.task.scale
        success = view.error < self.task.tolerance
        if state.controller is None:
            # A bad action has no size; the row's reward is that of where it stays.
            cost = cost + EFFORT * action.square().mean(-1).nan_to_num()
        else:
            assert self.loop is not None  # it made the state
            model = self.loop.model_points(state.controller, state.rows.lengths)
            cost = cost + (model - points).norm(dim=-1).mean(-1) / MODEL_SCALE
        return (success.to(cost.dtype) - cost).float()


class _Moved(NamedTuple):
    """The parts of a state that a step moves."""

    arm: KinematicState | DynamicState
    q_d: Tensor
    y: Tensor
    controller: ControllerState | None


def _sensors(points: Tensor) -> Tensor:
    """Of the middles and ends (N, 6, 3) of the sections, their ends (N, 3, 3), where the sensors sit."""
    return points[:, 1::2]
