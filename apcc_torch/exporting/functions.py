"""What a library offers: modules of torch, each a function of named structs."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from apcc_torch.control.composite_controller import CompositeController, CompositeState
from apcc_torch.control.controller import APCCController
from apcc_torch.control.estimate_covariance import SensorNoise, estimate_covariance
from apcc_torch.control.pid import TendonPID
from apcc_torch.control.step_io import ControllerState, Measurement, Target
from apcc_torch.exporting.tuples import (
    Answer,
    Beginning,
    ShapeUncertainty,
    TendonForces,
    TendonInput,
    TendonMemory,
    Uncertainty,
)
from apcc_torch.hardware.control import blank_step, warmed_up

Controller = APCCController | CompositeController


class Function(NamedTuple):
    """A function of a library.

    name: Behind the library's own. meaning: In a sentence.
    module: What it computes.
    takes: Names of the module's arguments: of structs, or of plain numbers.
    example: Those arguments, of one row.
    gives: Names of its results; one that it takes too is written over.
    stamp: MEMBER or STRUCT.MEMBER of the newest time among its arguments; "" where there is no stamp.
    """

    name: str
    meaning: str
    module: nn.Module
    takes: tuple[str, ...]
    example: tuple[Any, ...]
    gives: tuple[str, ...]
    stamp: str = ""


def kinematic(controller: Controller) -> APCCController:
    """The controller of the kinematics."""
    return controller.kinematic if isinstance(controller, CompositeController) else controller


def kinematic_state(state: ControllerState | CompositeState) -> ControllerState:
    """Its state."""
    return state.kinematic if isinstance(state, CompositeState) else state


class ControlStep(nn.Module):
    """A control step.

    Args:
        controller: With a routing.
    """

    def __init__(self, controller: Controller) -> None:
        super().__init__()
        self.controller = controller

    def forward(self, state: Any, measurement: Measurement, target: Target) -> tuple[Any, Answer]:
        """The next state and the answer."""
        later, command = self.controller(state, measurement, target)
        now, feedback = kinematic_state(later), command.feedback
        return later, Answer(
            command.y,
            command.q_d,
            command.qdot,
            command.force,
            command.pressure,
            command.e,
            command.limits,
            feedback.q_bar,
            now.pi_hat,
            feedback.status,
            feedback.iterations,
            feedback.angular_error,
            feedback.linear_error,
            None if now.shape is None else now.shape.shape.load,
        )


class ControlCovariance(nn.Module):
    """How sure the estimate of a step is, see `estimate_covariance`.

    Args:
        controller: That makes the steps.
        noise: Of the sensors, for algorithm 2.
    """

    def __init__(self, controller: Controller, noise: SensorNoise) -> None:
        super().__init__()
        self.controller = controller
        self.noise = noise

    def forward(self, before: Any, state: Any, measurement: Measurement) -> Uncertainty | ShapeUncertainty:
        """The covariance, from the states before and after the step and its measurement."""
        states = kinematic_state(before), kinematic_state(state)
        inner = kinematic(self.controller)
        kind = Uncertainty if inner.shape is None else ShapeUncertainty
        return kind(estimate_covariance(inner, *states, measurement, self.noise))


class ControlStart(nn.Module):
    """The state before the first measurement."""

    def __init__(self, controller: Controller) -> None:
        super().__init__()
        self.controller = controller

    def forward(self, beginning: Beginning) -> Any:
        """The state."""
        return self.controller.initial_state(beginning.q, beginning.pi_hat, beginning.time)


class ControlRestart(nn.Module):
    """The state before the first measurement, of the shape that a warm-up has found.

    Args:
        controller: With a routing.
        pi_hat: (n_b,) first estimates, m.
    """

    pi_hat: Tensor

    def __init__(self, controller: Controller, pi_hat: Tensor) -> None:
        super().__init__()
        self.controller = controller
        self.register_buffer("pi_hat", pi_hat)

    def forward(self, state: Any, time: Tensor) -> Any:
        """The state, at a time () s."""
        q = warmed_up(kinematic(self.controller), kinematic_state(state), self.pi_hat)
        return self.controller.initial_state(q, self.pi_hat, time)


class TendonLoop(nn.Module):
    """One period of the loop on the tendons' lengths."""

    def __init__(self, pid: TendonPID) -> None:
        super().__init__()
        self.pid = pid

    def forward(self, loop: TendonMemory, tendons: TendonInput) -> tuple[TendonMemory, TendonForces]:
        """The loop's integral after the period, and the forces during it."""
        y, y_d = tendons.y, tendons.y_d
        u = self.pid(loop.z, y, tendons.ydot, y_d, tendons.ydot_d, tendons.force)
        return TendonMemory(self.pid.integrate(loop.z, y, y_d, tendons.dt.unsqueeze(-1))), TendonForces(u)


def blank(controller: Controller, pi_hat: Tensor) -> tuple[Any, Measurement, Target]:
    """Arguments of the form that every step of a library has, without what the controller does not read."""
    inner = kinematic(controller)
    state: Any
    state, measurement, target = blank_step(inner, pi_hat)
    if inner.shape is None:
        measurement = measurement._replace(tendons=None)
    if isinstance(controller, CompositeController):
        assert inner.routing is not None  # it takes no other
        measurement = measurement._replace(forces=torch.zeros(inner.routing.n_tendons, dtype=pi_hat.dtype))
        state = controller.initial_state(state.q_bar, pi_hat, state.time)
    return state, measurement, target


def control_functions(controller: Controller, pi_hat: Tensor, noise: SensorNoise | None) -> list[Function]:
    """A controller's functions.

    Args:
        controller: With a routing.
        pi_hat: (n_b,) first estimates, m.
        noise: Of the sensors, for the covariance; None for none.
    """
    state, measurement, target = blank(controller, pi_hat)
    time = measurement.time
    beginning = Beginning(torch.zeros(kinematic(controller).backbone.n, dtype=pi_hat.dtype), pi_hat, time)
    made = [
        Function(
            "start",
            "The state before the first measurement.",
            ControlStart(controller),
            ("beginning",),
            (beginning,),
            ("state",),
            "beginning.time",
        ),
        Function(
            "restart",
            "The state before the first measurement, at `time`, in s: of the shape that steps have found, with the\n"
            "    first estimates.",
            ControlRestart(controller, pi_hat),
            ("state", "time"),
            (state, time),
            ("state",),
            "time",
        ),
        Function(
            "step",
            "One control step.",
            ControlStep(controller),
            ("state", "measurement", "target"),
            (state, measurement, target),
            ("state", "command"),
            "measurement.time",
        ),
    ]
    if noise is None:
        return made
    sure = Function(
        "covariance",
        "How sure the estimate of a step is, from the states before and after it and its measurement.",
        ControlCovariance(controller, noise),
        ("before", "state", "measurement"),
        (state, state, measurement),
        ("uncertainty",),
        "measurement.time",
    )
    return [*made, sure]


def loop_function(pid: TendonPID, n_tendons: int, feed_forward: bool, like: Tensor) -> Function:
    """The loop on the lengths of `n_tendons` tendons, in the type of `like`."""
    zero = torch.zeros(n_tendons, dtype=like.dtype)
    tendons = TendonInput(zero, zero, zero, zero, zero if feed_forward else None, torch.zeros_like(zero[0]))
    return Function(
        "loop_step",
        "One period of the loop on the tendons' lengths: the forces that it asks for.",
        TendonLoop(pid),
        ("loop", "tendons"),
        (TendonMemory(zero), tendons),
        ("loop", "forces"),
    )
