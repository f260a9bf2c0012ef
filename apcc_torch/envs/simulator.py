"""The environments' physics as pure functions: a state and an action in, a state and what came of it out.

Nothing here asks for a value, so one step can be compiled whole and runs on any device; rows never meet.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from apcc_torch.control.step_io import ControllerState
from apcc_torch.envs.actions import Drive
from apcc_torch.envs.adaptation import AdaptiveLoop, AdaptiveLoopSettings
from apcc_torch.envs.backbone_points import Positions
from apcc_torch.envs.dynamic import DynamicArm, DynamicArmSettings
from apcc_torch.envs.kinematic import KinematicArm, KinematicState
from apcc_torch.envs.outcome import Outcome, TruncatedReason, View
from apcc_torch.envs.places import places
from apcc_torch.envs.pressing import Pressing
from apcc_torch.envs.randomisation import Ranges, RowParameters
from apcc_torch.envs.rendering import Picture, picture
from apcc_torch.envs.row_trees import select
from apcc_torch.envs.sensing import Readings, Sensing
from apcc_torch.envs.streams import Stream
from apcc_torch.envs.tasks import Goal, Reach
from apcc_torch.errors import ConfigError
from apcc_torch.model.arm import Arm
from apcc_torch.part import Part
from apcc_torch.reading import read
from apcc_torch.settings import OURS, resolved, setting
from apcc_torch.simulation.divergence import Divergence, DivergenceSettings, stretch
from apcc_torch.simulation.plant_state import PlantState


@dataclass(frozen=True, kw_only=True)
class SimulatorSettings(AdaptiveLoopSettings, DynamicArmSettings, Ranges):
    """Settings of `Simulator`: all but the task's."""

    control_rate: float = setting(100.0, "Hz", OURS, "steps a second", above=0)
    max_episode_steps: int | None = setting(
        None, "", OURS, "steps after which a row is truncated; null: no limit", least=1
    )
    effort: float = setting(0.01, "", OURS, "what an action of mean square 1 costs a step", least=0)
    model_scale: float = setting(0.05, "m", OURS, "adaptation: error of the virtual model that costs 1 a step", above=0)
    position_bound: float = setting(
        5.0 / 3.0, "", OURS, "bound of observed positions over the arm's length; differences: twice", above=0
    )
    speed_bound: float = setting(25.0 / 3.0, "1/s", OURS, "bound of observed velocities over the arm's length", above=0)
    divergence: Mapping[str, Any] = setting(
        factory=dict, unit="", source=OURS, meaning="what differs from `DivergenceSettings`, by name"
    )
    tendon_bound: float = setting(
        5.0 / 6.0, "", OURS, "bound of observed changes of tendon lengths over the arm's length", above=0
    )

    def check(self) -> None:
        """Raises ConfigError where a setting is a tensor: rows differ by what is drawn for them."""
        super().check()
        self.divergence_settings()
        for each in fields(self):
            if isinstance(getattr(self, each.name), Tensor):
                raise ConfigError(f"{each.name} must be a number: rows of an environment differ by its ranges")

    def divergence_settings(self) -> DivergenceSettings:
        """What says that a row has diverged."""
        return read(self.divergence, DivergenceSettings, "divergence")


class Body(Protocol):
    """The true arms: `KinematicArm` or `DynamicArm`, each with its own state."""

    def lengths(self, rows: RowParameters) -> Tensor: ...
    def initial(self, rows: RowParameters) -> Any: ...
    def step(self, state: Any, y: Tensor, y_next: Tensor, q_d: Tensor, rows: RowParameters) -> Any: ...
    def points(self, state: Any, rows: RowParameters) -> Positions: ...
    def tendons(self, state: Any) -> Tensor: ...
    def configuration(self, state: Any) -> Tensor: ...
    def coordinates(self, state: Any) -> tuple[Tensor, ...]: ...


class EnvState(NamedTuple):
    """Everything about N rows between two steps.

    rows: What was drawn at their resets. goal: The task's.
    arm: Of the kinematic or the dynamic arm. q_d: (N, 3 n_b), (N, n) of a controller with another model.
    y: (N, n_a) what tendons are told, m; of the chambers of a dynamic arm, Pa.
    controller: Of the adaptive loop; None without one.
    readings: Of the sensors. stream: Their random numbers. step: (N,) int64 since the reset.
    """

    rows: RowParameters
    goal: Goal
    arm: KinematicState | PlantState
    q_d: Tensor
    y: Tensor
    controller: ControllerState | None
    readings: Readings
    stream: Stream
    step: Tensor


class Simulator(Part):
    """One task for any number of arms.

    Args:
        task: The task.
        arm: What the arms are nominally.
        like: Dtype of the physics, and device.
        *settings, **changes: See `SimulatorSettings`.

    Raises:
        ConfigError, ValueRangeError: A setting has no meaning.
    """

    settings_type = SimulatorSettings

    nominal: Tensor
    B: Tensor
    bounds: Tensor
    max_episode_steps: int | None
    effort: float
    model_scale: float

    def __init__(self, task: Reach, arm: Arm, like: Tensor, *settings: Any, **changes: Any) -> None:
        super().__init__()
        s = resolved(SimulatorSettings, settings, changes)
        self.hold(s)
        self.task, self.description = task, arm
        self.period = 1.0 / s.control_rate
        self.ranges = resolved(Ranges, (s,), {})
        self.arm: Body
        if s.dynamics == "kinematic":
            self.arm = KinematicArm(arm, like)
        else:
            varied = self.ranges.varies("lengths") or self.ranges.varies("stiffness")
            self.arm = DynamicArm(arm, self.period, varied, like, s)
        adapts = s.action == "adaptation"
        self.loop = AdaptiveLoop(arm, like, s) if adapts else None
        self.pressing = Pressing.of(arm, like, s.action) if s.dynamics == "dynamic" else None
        self.drive = None if adapts or s.action == "pressures" else Drive(arm, self.period, like, s)
        self.sensing = Sensing(s.noise[1] > 0, int(s.delay[1]))
        self.judge = Divergence(s.divergence_settings())
        self.action_size, self.bound = s.size(arm), s.plant_settings().bound
        self.register_buffer("nominal", arm.rest_lengths().to(like))
        self.register_buffer("B", arm.routing().to(like).matrix(self.nominal))
        self.register_buffer("bounds", torch.tensor(self._bounds(s), dtype=torch.float32, device=like.device))

    def _bounds(self, s: SimulatorSettings) -> list[float]:
        """The largest magnitude of every number that is observed."""
        length = float(self.description.rest_lengths().sum())
        position, speed, tendon = (b * length for b in (s.position_bound, s.speed_bound, s.tendon_bound))
        k, observed = self.task.n_sensors, self.task.observed()
        told = tendon if self.pressing is None else 1.0
        bounds = [position] * 3 * k + [speed] * 3 * k + [told] * 2 * self.description.n_tendons
        bounds += [position] * observed.positions + [2.0 * position] * observed.differences
        bounds += [speed] * observed.velocities
        if self.loop is not None:
            bounds += [position] * self.description.n_sections + [2.0 * position] * k
        return bounds

    def initial(self, stream: Stream) -> EnvState:
        """Rows at the start of an episode: parameters and goal drawn, the arm hanging at rest."""
        stream, rows = self.ranges.draw(stream, len(self.nominal), self.nominal.dtype)
        lengths = self.nominal * rows.lengths
        stream, goal = self.task.draw(stream, lengths)
        arm = self.arm.initial(rows)
        points = self.arm.points(arm, rows)
        stream, readings = self.sensing.initial(points.sensors.flatten(1), rows, stream)
        q_d, controller = torch.zeros_like(lengths).repeat_interleave(3, dim=-1), None
        y = q_d @ self.B if self.pressing is None else self.pressing.at_rest(q_d)
        if self.loop is not None:
            controller = self.loop.initial(readings.seen.unflatten(-1, (-1, 3)), rows.lengths, rows.estimate)
            q_d = controller.q_d
        return EnvState(rows, goal, arm, q_d, y, controller, readings, stream, torch.zeros_like(stream.drawn))

    def view(self, state: EnvState) -> View:
        """What the state looks like."""
        return self._view(state, self.arm.points(state.arm, state.rows), self._model_points(state))

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
        length = self.arm.lengths(state.rows).sum(-1)
        good = (largest <= self.bound) & (self.judge.now(length, self._stretches(arm, controller, state.rows)) == 0)
        arm, q_d, y, controller = select(
            good, _Moved(arm, q_d, y, controller), _Moved(state.arm, state.q_d, state.y, state.controller)
        )
        points = self.arm.points(arm, state.rows)
        stream, readings = self.sensing.read(state.readings, points.sensors.flatten(1), state.rows, state.stream)
        step = state.step + 1
        later = EnvState(state.rows, state.goal, arm, q_d, y, controller, readings, stream, step)
        model = self._model_points(later)
        view = self._view(later, points, model)
        reason = torch.where(torch.isfinite(largest), TruncatedReason.DIVERGED.value, TruncatedReason.NOT_FINITE.value)
        late = torch.zeros_like(step)
        if self.max_episode_steps is not None:
            late = torch.where(step >= self.max_episode_steps, TruncatedReason.TIME_LIMIT.value, late)
        if model is not None:
            gap = (model.backbone - points.backbone).norm(dim=-1).mean(-1)
            lost = self.judge.now(length, self._stretches(arm, controller, state.rows), gap) > 0
            late = torch.where(lost, TruncatedReason.DIVERGED.value, late)
        reason = torch.where(good, late, reason)
        return later, Outcome(view, self._reward(action, view, points, model), reason > 0, reason)

    def picture(self, state: EnvState) -> Picture:
        """What a renderer draws of the one row of a state."""
        q = self.arm.configuration(state.arm)[0]
        time = self.period * state.step.to(q.dtype)
        text = f"t = {float(time):.2f} s, error {1e3 * float(self.view(state).error):.0f} mm"
        if isinstance(self.arm, DynamicArm):
            text += f", payload {float(state.rows.payload):.2f} kg"
        arm, lengths = self.description, self.arm.lengths(state.rows)[0]
        routing = arm.routing().to(q)
        routing.anchors = (
            places(arm.routing().anchors, arm.rest_lengths()).to(q).on(self.nominal * state.rows.lengths[0])
        )
        sensors, goal = self.arm.points(state.arm, state.rows).sensors[0], self.task.drawn(state.goal, time)
        return picture(q, lengths, arm.base_rotation().to(q), routing, sensors, goal, text)

    def _command(self, state: EnvState, action: Tensor) -> tuple[Tensor, Tensor, ControllerState | None]:
        """The next q_d, what tendons or chambers are told (N, n_a), and the controller's state."""
        if self.drive is not None:
            q_d = self.drive(state.q_d, action)
            y = q_d @ self.B
            return q_d, y if self.pressing is None else self.pressing.holding(y), None
        if self.pressing is not None and self.loop is None:
            return state.q_d, self.pressing.asked(action), None
        assert self.loop is not None and state.controller is not None  # one of the two drives
        time = self.period * state.step.to(action.dtype)
        # The first step integrates one period too: the state's stamp is one period before the first measurement.
        seen = state.readings.seen.unflatten(-1, (-1, 3))
        target = self.task.target(state.goal, time)
        controller, command = self.loop(state.controller, action, seen, time + self.period, target, state.rows.lengths)
        y = command.q_d @ self.B if command.y is None else command.y
        if command.pressure is not None:
            y = command.pressure
        return command.q_d, y, controller

    def _stretches(
        self, arm: KinematicState | PlantState, controller: ControllerState | None, rows: RowParameters
    ) -> Tensor:
        """(N, m) elongations of the arm's sections, and of the model's, over their rest lengths."""
        arms = stretch(self.arm.configuration(arm), self.arm.lengths(rows))
        if self.loop is None or controller is None:
            return arms
        of = self.loop.controller.backbone.coordinates
        return torch.cat((arms, stretch(controller.q_bar, controller.pi_hat, of)), dim=-1)

    def _model_points(self, state: EnvState) -> Positions | None:
        """Where the controller's model has the arm; None without a controller."""
        if self.loop is None or state.controller is None:
            return None
        return self.loop.model_points(state.controller, state.rows.lengths)

    def _view(self, state: EnvState, points: Positions, model: Positions | None) -> View:
        """The view of a state whose points are known, and those of its model."""
        time = self.period * state.step.to(self.nominal.dtype)
        seen = state.readings.seen
        velocity = (seen - state.readings.before) / self.period
        sensors = seen.unflatten(-1, (-1, 3))
        tendons, told = self.arm.tendons(state.arm), state.y
        if self.pressing is not None:
            tendons, told = self.pressing.seen(tendons), self.pressing.seen(told)
        parts = [seen, velocity, tendons, told, self.task.features(state.goal, time, sensors)]
        if state.controller is not None and model is not None:
            parts += [state.controller.pi_hat, (model.sensors - sensors).norm(dim=-1)]
        observation = torch.cat(parts, dim=-1).float()
        return View(observation.clamp(-self.bounds, self.bounds), self.task.error(state.goal, time, points))

    def _reward(self, action: Tensor, view: View, points: Positions, model: Positions | None) -> Tensor:
        cost = view.error / self.task.scale
        success = view.error < self.task.tolerance
        if model is None:
            # A bad action has no size; the row's reward is that of where it stays.
            size = action.square().mean(-1)
            cost = cost + self.effort * size.masked_fill(size.isnan(), 0.0)
        else:
            cost = cost + (model.backbone - points.backbone).norm(dim=-1).mean(-1) / self.model_scale
        return (success.to(cost.dtype) - cost).float()


class _Moved(NamedTuple):
    """The parts of a state that a step moves."""

    arm: KinematicState | PlantState
    q_d: Tensor
    y: Tensor
    controller: ControllerState | None
