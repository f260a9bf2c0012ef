"""The simulated arm: a plant, its motors and its cameras, stepped ahead of the time it is read at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from apcc_torch.control.pid import TendonPID, TendonReference
from apcc_torch.errors import ValueRangeError
from apcc_torch.hardware.simulated.board import Board, Mode
from apcc_torch.model.abscissae import decouple
from apcc_torch.model.tendons import TendonRouting
from apcc_torch.native.compiled import Step, compiled
from apcc_torch.settings import check_setting
from apcc_torch.simulation.plant import Plant, PlantState, PlantStep
from apcc_torch.simulation.sensors import PoseSensors, SensorState


@dataclass(frozen=True)
class SimulatedSettings:
    """What the simulated devices are like.

    step: s, of the plant. frame_rate: Hz, of the sensors. frame_latency: s from measurement to arrival.
    motor_speed: m/s at which a tendon runs to its goal. resolution: m, one encoder tick.
    settle: s that the arm hangs before it is connected. seed: Of the sensors' noise.
    compile: How the plant is stepped, one of `native.compiled.MODES`.

    Raises:
        ValueRangeError: A number is out of range.
    """

    step: float = 5e-3
    frame_rate: float = 50.0
    frame_latency: float = 8e-3
    motor_speed: float = 0.3
    resolution: float = 1.5e-5
    settle: float = 3.0
    seed: int = 0
    compile: str = "off"

    def __post_init__(self) -> None:
        """Checks the numbers."""
        for name in ("step", "frame_rate", "motor_speed", "resolution"):
            check_setting(f"simulated.{name}", getattr(self, name))
        for name in ("frame_latency", "settle"):
            check_setting(f"simulated.{name}", getattr(self, name), zero=True)


class SimulatedArm:
    """The arm. It is handed to its process before `begin`, so nothing in it depends on the process.

    The plant's tendon loop is the compliance between a motor and the arm: encoders read the motor's side, which runs
    to its goal at a bounded speed. Without torque the motors are dragged along, and the arm drops.

    Args:
        plant: The true arm, one row.
        routing: The plant's.
        sensors: Noise and dropout.
        abscissae: (k,) where the sensors sit, m.
        settings: The devices.

    Raises:
        ValueRangeError: The plant has more than one row.
    """

    def __init__(
        self,
        plant: Plant,
        routing: TendonRouting,
        sensors: PoseSensors,
        abscissae: Tensor,
        settings: SimulatedSettings,
    ) -> None:
        if plant.payload.shape != (1,):
            raise ValueRangeError(f"a simulated arm is one row with one payload, got {tuple(plant.payload.shape)}")
        self.plant = plant
        self.limp = Plant(
            plant.dynamics,
            routing,
            TendonPID(0.0, 0.0, 0.0),
            plant.payload,
            plant.tendon_damping,
            plant.transmission,
            plant.bound,
        )
        self.sensors = sensors
        self.settings = settings
        self.X_tilde, self.j = decouple(abscissae, plant.dynamics.lengths)
        self.n_bodies = abscissae.shape[-1]
        self.n_tendons = plant.B.shape[-1]
        self.time = 0.0
        self.next_frame = 0.0

    def begin(self, time: float, board: Board) -> None:
        """Lets the arm settle on its stand, and puts the first knot and frame at `time`, s."""
        settings = self.settings
        # Here, as compiled code does not travel between processes.
        self.held, self.dragged = (self._stepped(plant) for plant in (self.plant, self.limp))
        self.now = self.plant.settled(settings.settle, settings.step, settings.compile)
        self.reference = torch.zeros_like(self.now.z)
        self.rate = torch.zeros_like(self.now.z)
        self.generator = torch.Generator().manual_seed(settings.seed)
        self.sensor_state: SensorState = self.sensors.initial_state(self._poses(self.now.arm.q))
        self.time = self.next_frame = time
        self._put(board, self._knot())
        self._frames(board, self.now, time)

    def _stepped(self, plant: Plant) -> Step:
        step = PlantStep(plant, self.settings.step)
        return compiled(step, step.blank(), self.settings.compile)

    def _poses(self, q: Tensor) -> Tensor:
        return self.plant.backbone.pose(q, self.plant.dynamics.lengths, self.X_tilde, self.j)

    def _knot(self) -> tuple[Tensor, Tensor, Tensor]:
        """y, ydot and effort on the motors' side."""
        u = self.plant.forces(self.now.arm, self.now.z, TendonReference(self.reference, self.rate))
        transmission = self.plant.transmission
        return self.reference, self.rate, torch.relu(-u) if transmission is not None and transmission.slack else -u

    def _put(self, board: Board, knot: tuple[Tensor, Tensor, Tensor]) -> None:
        y, ydot, effort = (value[0].numpy() for value in knot)
        board.put_knot(self.time, y, ydot, effort)

    def advance(self, board: Board, goal: np.ndarray, mode: Mode) -> None:
        """One plant step towards a goal (n_a,), m; the board gets its knot and the frames that fall into it.

        Args:
            board: Written to at the end, in one go; the caller holds the lock around what it wants whole.
            goal: Where the motors go, if they have torque.
            mode: What the motors do.
        """
        dt = self.settings.step
        before = self.now
        if mode is Mode.LIMP:
            still = torch.zeros_like(self.reference)
            self.now = self.dragged(before, TendonReference(still, still))._replace(z=still)
            self.reference = self.plant.lengths(self.now.arm.q)
            self.rate = self.plant.lengths(self.now.arm.qdot)
            knot = self.reference, self.rate, torch.zeros_like(self.rate)
        else:
            wanted = torch.from_numpy(goal).to(self.reference).unsqueeze(0)
            reach = self.settings.motor_speed * dt
            delta = (wanted - self.reference).clamp(-reach, reach)
            self.reference, self.rate = self.reference + delta, delta / dt
            self.now = self.held(before, TendonReference(self.reference, self.rate))
            knot = self._knot()
        self.time += dt
        board.memory["diverged"] = int(self.now.diverged_at[0] >= 0)
        self._frames(board, before, self.time - dt)
        self._put(board, knot)

    def _frames(self, board: Board, before: PlantState, begin: float) -> None:
        """The frames that are due up to now, of the arm on its way from `before` at `begin`, s."""
        span = self.time - begin
        while self.next_frame <= self.time + 1e-9:
            share = 1.0 if span <= 0 else (self.next_frame - begin) / span
            q = torch.lerp(before.arm.q, self.now.arm.q, share)
            self.sensor_state, T, mask = self.sensors(self.sensor_state, self._poses(q), self.generator)
            board.put_frame(self.next_frame, T[0].numpy(), mask[0].numpy())
            self.next_frame += 1.0 / self.settings.frame_rate

    def skip(self, seconds: float) -> None:
        """Lets `seconds` pass without the arm: it could not be computed in time."""
        self.time += seconds
        self.next_frame = max(self.next_frame, self.time)
