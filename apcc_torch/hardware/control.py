"""The controller as the loop calls it: numbers in, numbers out, the state kept in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apcc_torch.control.ahead import AheadStatus
from apcc_torch.control.controller import APCCController
from apcc_torch.control.step_io import Command, ControllerState, Measurement, Target
from apcc_torch.control.trajectory import Trajectory
from apcc_torch.errors import ConfigError
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.looking_ahead import LookingAhead
from apcc_torch.hardware.sensing import GatedFrame
from apcc_torch.native.standing import StandingCall
from apcc_torch.native.structure import mapped

Step = Callable[[ControllerState, Measurement, Target], tuple[ControllerState, Command]]
"""One control step: the controller itself, or a compiled form of it."""


def blank_step(controller: APCCController, pi_hat: Tensor) -> tuple[ControllerState, Measurement, Target]:
    """Arguments of the form that every step of a loop has: what a compiler needs to see.

    Args:
        controller: With a routing.
        pi_hat: (n_b,) m.
    """
    assert controller.routing is not None
    q, zero = torch.zeros(controller.backbone.n, dtype=pi_hat.dtype), torch.zeros(3, dtype=pi_hat.dtype)
    time = torch.zeros((), dtype=torch.float64)
    k = controller.feedback.abscissae.shape[-1]
    every = torch.ones(k, dtype=torch.bool)
    T, y = (
        torch.eye(4, dtype=pi_hat.dtype).expand(k, 4, 4),
        torch.zeros(controller.routing.n_tendons, dtype=pi_hat.dtype),
    )
    measurement = Measurement(T, time, every, every, tendons=y if controller.pressure is None else None)
    return controller.initial_state(q, pi_hat, time), measurement, Target(zero, zero)


class Goal(NamedTuple):
    """Where the end effector should be: x_d (3,) m, and xdot_d (3,) m/s."""

    x_d: Array
    xdot_d: Array


def warmed_up(controller: APCCController, state: ControllerState, pi_hat: Tensor) -> Tensor:
    """q (..., n) of the shape that a warm-up has found: what it made rest length is elongation of pi_hat again."""
    return state.q_bar + controller.backbone.coordinates.on_elongations(state.pi_hat - pi_hat)


@dataclass(frozen=True)
class Decision:
    """One step of the controller.

    time: s since the start, of the measurement. x_d, xdot_d, e: (3,) m, m/s, m. y: (n_a,) wanted length changes, m.
    q_bar, qdot, q_d: (3 n_b,). pi_hat: (n_b,) m. status: `FeedbackStatus`. angular_error, linear_error: (k,) rad, m.
    pressure: (n_a,) wanted of chambers, Pa; None of tendons. ahead: `AheadStatus`; None of a controller that does not
    look ahead.
    """

    time: float
    x_d: Array
    xdot_d: Array
    e: Array
    y: Array
    q_bar: Array
    qdot: Array
    q_d: Array
    pi_hat: Array
    status: int
    iterations: int
    angular_error: Array
    linear_error: Array
    pressure: Array | None = None
    ahead: int | None = None

    @property
    def command(self) -> Array:
        """(n_a,) what the actuator is asked for: pressures of chambers, Pa, else lengths, m."""
        return self.y if self.pressure is None else self.pressure


@dataclass(frozen=True)
class Start:
    """Where the controller starts: q (3 n_b,), pi_hat (n_b,) m, and the stamp of its first measurement, s."""

    q: Array
    pi_hat: Array
    time: float


class Control:
    """Runs the controller on frames. Its state, its measurement and its command stay in the same memory.

    Args:
        controller: With a routing.
        trajectory: Targets over the time since the start.
        pi_hat: (n_b,) first estimates, m.
        step: The step to call; None for the controller itself.
        targets: What the trajectory comes to at a time, such as a compiled form of it; None for itself.
        looking: How it looks ahead between its steps; None where it does not.

    Raises:
        ConfigError: The controller has no routing.
    """

    def __init__(
        self,
        controller: APCCController,
        trajectory: Trajectory,
        pi_hat: Tensor,
        step: Step | None = None,
        targets: Callable[[Tensor], Target] | None = None,
        looking: LookingAhead | None = None,
    ) -> None:
        if controller.routing is None:
            raise ConfigError("the controller of an arm needs a tendon routing")
        self.controller = controller
        self.n_tendons = controller.routing.n_tendons
        self.sets_pressure = controller.pressure is not None
        self.n_bodies = controller.feedback.abscissae.shape[-1]
        self.trajectory = trajectory
        self.pi_hat = pi_hat
        self.looking = looking
        self.step: Step = controller if step is None else step
        self._call = StandingCall(self.step, blank_step(controller, pi_hat), carries=True)
        self._aim = StandingCall(targets or trajectory, (torch.zeros((), dtype=pi_hat.dtype),))

    @property
    def state(self) -> ControllerState:
        """What the controller remembers, as it is now."""
        given = self._call.given[0]
        state: ControllerState = mapped(lambda array: torch.from_numpy(array.copy()), given)
        return state

    def _set(self, q: Tensor, pi_hat: Tensor, time: float) -> None:
        state = self.controller.initial_state(q, pi_hat, torch.tensor(time, dtype=torch.float64))
        mapped(lambda array, value: np.copyto(array, value.numpy()), self._call.given[0], state)

    def _measured(self, frame: GatedFrame, lengths: Array, time: float) -> None:
        measurement = self._call.given[1]
        measurement.T[...] = frame.T
        measurement.time[...] = time
        measurement.mask[...] = frame.position_ok
        measurement.angular_mask[...] = frame.orientation_ok
        if not self.sets_pressure:
            measurement.tendons[...] = lengths

    def warm_up(
        self, frame: GatedFrame, lengths: Array, steps: int, period: float, now: Callable[[], float]
    ) -> list[float]:
        """Steps on one frame with the end effector as its own target: nothing is asked of the arm.

        It also brings q_bar from the straight arm to the measured one.

        Args:
            frame: A complete frame.
            lengths: (n_a,) measured length changes of the tendons, m.
            steps: How many.
            period: Time that the stamps pretend to pass between two steps, s.
            now: The clock.

        Returns:
            Each step's time, s.
        """
        target = self._call.given[2]
        target.x_d[...], target.xdot_d[...] = frame.T[-1, :3, 3], 0.0
        took = []
        for k in range(steps):
            began = now()
            self._measured(frame, lengths, (k + 1) * period)
            self._call()
            took.append(now() - began)
            self.look_ahead(now, torch.inf)
        return took

    def start(self, time: float) -> Start:
        """The state before the first step: q_bar as the warm-up left it, the first estimates.

        Args:
            time: Stamp before the first measurement, s.
        """
        q = warmed_up(self.controller, self.state, self.pi_hat)
        self._set(q, self.pi_hat, time)
        return Start(numbers(q), numbers(self.pi_hat), time)

    def restart(self, start: Start) -> None:
        """Goes to a start that was recorded."""
        q, pi_hat = (torch.from_numpy(v).to(self.pi_hat.dtype) for v in (start.q, start.pi_hat))
        self._set(q, pi_hat, start.time)

    def decide(self, frame: GatedFrame, lengths: Array, time: float, goal: Goal | None = None) -> Decision:
        """One step.

        Args:
            frame: A usable frame.
            lengths: (n_a,) measured length changes of the tendons, m; not used of chambers, which have none.
            time: The frame's stamp, s since the start.
            goal: Where to go; None for the trajectory's.

        Raises:
            ApccError: The controller refuses its input.
        """
        self._measured(frame, lengths, time)
        target = self._call.given[2]
        if goal is None:
            self._aim.given[0][...] = time
            self._aim()
            aimed = self._aim.results
            goal = Goal(aimed.x_d, aimed.xdot_d)
        target.x_d[...], target.xdot_d[...] = goal
        self._call()
        state, command = self._call.results
        feedback = command.feedback
        if command.y is None:
            raise ConfigError("the step of a controller with tendons must return their lengths")
        return Decision(
            time,
            numbers(target.x_d),
            numbers(target.xdot_d),
            numbers(command.e),
            numbers(command.y),
            numbers(feedback.q_bar),
            numbers(command.qdot),
            numbers(command.q_d),
            numbers(state.pi_hat),
            int(feedback.status),
            int(feedback.iterations),
            numbers(feedback.angular_error),
            numbers(feedback.linear_error),
            None if command.pressure is None else numbers(command.pressure),
            None if state.ahead is None else int(state.ahead.status),
        )

    def look_ahead(self, now: Callable[[], float], deadline: float) -> None:
        """Looks ahead from the last step, where the controller does and there is time for it.

        Args:
            now: The clock, s.
            deadline: Of the loop's next turn, s.
        """
        if self.looking is None:
            return
        state, _, target = mapped(torch.from_numpy, self._call.given)
        if int(state.ahead.next) != AheadStatus.NONE:
            return  # nothing new was seen since
        later = self.looking(state, target, now, deadline)
        if later is not None:
            mapped(lambda array, value: np.copyto(array, value.numpy()), self._call.given[0].ahead, later)


def numbers(value: Tensor | NDArray[Any]) -> Array:
    """A copy as float64 numbers, bit for bit where it is float64."""
    return np.array(value.numpy() if isinstance(value, Tensor) else value, dtype=np.float64)
