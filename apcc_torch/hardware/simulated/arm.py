"""The simulated arm: a plant, its motors and its cameras, stepped ahead of the time it is read at."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from apcc_torch.control.pid import TendonReference
from apcc_torch.errors import ValueRangeError
from apcc_torch.hardware.simulated.board import Board, Mode
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.arm_dynamics import ArmDynamics
from apcc_torch.model.integrators import ArmState
from apcc_torch.model.kinematic_model import KinematicModel
from apcc_torch.native.compiled import Step


class PlantNow(Protocol):
    """The state of a plant: the arm, the integral z of its tendon loop, and when it diverged."""

    @property
    def arm(self) -> ArmState: ...
    @property
    def z(self) -> Tensor: ...
    @property
    def diverged_at(self) -> Tensor: ...
    @property
    def held(self) -> Tensor: ...
    def _replace(self, *, z: Tensor = ..., held: Tensor = ...) -> Self: ...


class TruePlant(Protocol):
    """What is needed of the true arm; `simulation.plant.Plant` has it."""

    payload: Tensor
    B: Tensor

    @property
    def dynamics(self) -> ArmDynamics: ...
    @property
    def sets_pressure(self) -> bool: ...
    def at_rest(self, z: Tensor) -> TendonReference: ...
    @property
    def backbone(self) -> KinematicModel: ...
    def limp(self) -> Self: ...
    def lengths(self, v: Tensor) -> Tensor: ...
    def tensions(self, now: Any, reference: TendonReference) -> Tensor: ...
    def settled(self, duration: float, dt: float, compile: str) -> PlantNow: ...
    def stepper(self, dt: float, compile: str) -> Step: ...


class TrueSensors(Protocol):
    """What stands between true and measured poses; `simulation.sensors.PoseSensors` has it."""

    def initial_state(self, T: Tensor) -> Any: ...
    def forward(self, state: Any, T: Tensor, generator: torch.Generator | None) -> tuple[Any, Tensor, Tensor]: ...


class SimulatedArm:
    """The arm. It is handed to its process before `begin`, so nothing in it depends on the process.

    The plant's tendon loop is the compliance between a motor and the arm: encoders read the motor's side, which runs
    to its goal at a bounded speed. Without torque the motors are dragged along, and the arm drops. Of an arm with
    chambers the board holds pressures, Pa, in place of lengths: valves let them follow the goal, and vent them without
    torque; on the stand they are those of rest.

    Args:
        plant: The true arm, one row.
        sensors: Noise and dropout.
        abscissae: (k,) where the sensors sit, m.
        step: s, of the plant.
        settle: s that the arm hangs before it is connected.
        seed: Of the sensors' noise.
        compile: How the plant is stepped, one of `native.compiled.MODES`.

    Attributes:
        motor_speed: m/s at which a tendon runs to its goal; the actuator sets it.
        frame_rate: Hz, of the cameras; the sensor sets it. Zero: there are none.

    Raises:
        ValueRangeError: The plant has more than one row.
    """

    def __init__(
        self,
        plant: TruePlant,
        sensors: TrueSensors,
        abscissae: Tensor,
        step: float = 5e-3,
        settle: float = 3.0,
        seed: int = 0,
        compile: str = "off",
    ) -> None:
        if plant.payload.shape != (1,):
            raise ValueRangeError(f"a simulated arm is one row with one payload, got {tuple(plant.payload.shape)}")
        self.plant = plant
        self.limp = plant.limp()
        self.sensors = sensors
        self.step, self.settle, self.seed, self.compile = step, settle, seed, compile
        self.X_tilde, self.j = decouple(abscissae, plant.dynamics.lengths)
        self.n_bodies = abscissae.shape[-1]
        self.n_tendons = plant.B.shape[-1]
        self.n = plant.backbone.n
        self.sets_pressure = plant.sets_pressure
        self.motor_speed, self.frame_rate = inf, 0.0
        self.time = 0.0
        self.next_frame = 0.0

    def steppers(self) -> tuple[Step, Step]:
        """The plant's step under torque, and the one without; built if they have to be, which may take a minute."""
        return self.plant.stepper(self.step, self.compile), self.limp.stepper(self.step, self.compile)

    def begin(self, now: Callable[[], float], board: Board) -> None:
        """Lets the arm settle on its stand, and puts the first knot and frame at the time `now` gives after that, s."""
        # Here, as compiled code does not travel between processes.
        self.held, self.dragged = self.steppers()
        self.now = self.plant.settled(self.settle, self.step, self.compile)
        self.reference = self.now.held if self.sets_pressure else torch.zeros_like(self.now.z)
        self.rate = torch.zeros_like(self.now.z)
        self.generator = torch.Generator().manual_seed(self.seed)
        self.sensor_state = self.sensors.initial_state(self._poses(self.now.arm.q))
        self.time = self.next_frame = now()
        self._put(board, self._tensions())
        self._frames(board, self.now, self.time)

    def _poses(self, q: Tensor) -> Tensor:
        return self.plant.backbone.pose(q, self.plant.dynamics.lengths, self.X_tilde, self.j)

    def _tensions(self) -> Tensor:
        """(1, n_a) on the motors' side, N; no regulator tells any."""
        if self.sets_pressure:
            return torch.zeros_like(self.rate)
        return self.plant.tensions(self.now, TendonReference(self.reference, self.rate))

    def _put(self, board: Board, effort: Tensor) -> None:
        y, ydot, effort_now = (value[0].numpy() for value in (self.reference, self.rate, effort))
        board.put_knot(self.time, y, ydot, effort_now)

    def advance(self, board: Board, goal: np.ndarray, mode: Mode) -> None:
        """One plant step towards a goal (n_a,), m; the board gets its knot and the frames that fall into it.

        Args:
            board: Written to at the end, in one go; the caller holds the lock around what it wants whole.
            goal: Where the motors go, if they have torque.
            mode: What the motors do.
        """
        dt = self.step
        before = self.now
        if self.sets_pressure:
            still = self.plant.at_rest(before.z)
            told = {Mode.STAND: still.pressure, Mode.POWERED: torch.from_numpy(goal).to(before.z).unsqueeze(0)}
            self.now = self.held(before, still._replace(pressure=told.get(mode, torch.zeros_like(before.z))))
            self.reference, self.rate = self.now.held, (self.now.held - before.held) / dt
            effort = self._tensions()
        elif mode is Mode.LIMP:
            zero = torch.zeros_like(self.reference)
            later = self.dragged(before, TendonReference(zero, zero))
            self.reference = self.plant.lengths(later.arm.q)
            self.rate = self.plant.lengths(later.arm.qdot)
            self.now = later._replace(z=zero, held=self.reference)
            effort = torch.zeros_like(self.rate)
        else:
            wish = torch.from_numpy(goal).to(self.reference).unsqueeze(0)
            reach = self.motor_speed * dt
            delta = (wish - self.reference).clamp(-reach, reach)
            self.reference, self.rate = self.reference + delta, delta / dt
            self.now = self.held(before, TendonReference(self.reference, self.rate))
            effort = self._tensions()
        self.time += dt
        board.memory["diverged"] = int(self.now.diverged_at[0] >= 0)
        self._frames(board, before, self.time - dt)
        self._put(board, effort)

    def _frames(self, board: Board, before: PlantNow, begin: float) -> None:
        """The frames that are due up to now, of the arm on its way from `before` at `begin`, s."""
        span = self.time - begin
        while self.frame_rate and self.next_frame <= self.time + 1e-9:
            share = 1.0 if span <= 0 else (self.next_frame - begin) / span
            q = torch.lerp(before.arm.q, self.now.arm.q, share)
            self.sensor_state, T, mask = self.sensors.forward(self.sensor_state, self._poses(q), self.generator)
            board.put_frame(self.next_frame, T[0].numpy(), mask[0].numpy(), q[0].numpy())
            self.next_frame += 1.0 / self.frame_rate

    def skip(self, seconds: float) -> None:
        """Lets `seconds` pass without the arm: it could not be computed in time."""
        self.time += seconds
        self.next_frame = max(self.next_frame, self.time)
