"""The motors of the simulated arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from apcc_torch.errors import CommunicationError, DataError, DeviceFaultError, HardwareError
from apcc_torch.hardware.interfaces import Array, PressureActuator, TendonActuator, TendonReading
from apcc_torch.hardware.simulated.board import Mode
from apcc_torch.hardware.simulated.world import SimulatedWorld, simulated
from apcc_torch.hardware.world import World
from apcc_torch.settings import OURS, Settings, resolved, setting

ROUND_OFF = 1e-9
"""Ticks: a limit that is a whole tick but for rounding is that tick."""


@dataclass(frozen=True, kw_only=True)
class SimulatedActuatorSettings(Settings):
    """What the simulated motors are like."""

    speed: float = setting(0.3, "m/s", OURS, "at which a tendon runs to its goal", above=0)
    resolution: float = setting(
        1.5e-5, "m", OURS, "tendon in one encoder tick: 4096 to a turn of a 10 mm spool", above=0
    )
    pressure_resolution: float = setting(50.0, "Pa", OURS, "of a regulator, on an arm with chambers", above=0)


class SimulatedActuator(TendonActuator):
    """Tendons on simulated motors: whole encoder ticks, bounded speed, compliance, and torque that can be off."""

    settings_type = SimulatedActuatorSettings
    needs_calibration = False

    def __init__(self, world: SimulatedWorld, *given: Any, **changes: Any) -> None:
        settings = resolved(SimulatedActuatorSettings, given, changes)
        self.world = world
        self.n_tendons = world.arm.n_tendons
        self.resolution = settings.resolution
        world.arm.motor_speed = settings.speed

    @classmethod
    def in_world(cls, settings: Settings, world: World) -> Self:
        """The motors of the world's arm; of one with chambers, their regulators."""
        lives: Any = SimulatedRegulators if simulated(world).arm.sets_pressure else cls
        made: Self = lives(simulated(world), settings)
        return made

    def connect(self) -> None:
        """Begins the arm's time; it hangs on its stand."""
        self.world.open("actuator")

    def calibrate(self) -> dict[str, object]:
        """Nothing is measured: the stand holds the tendons at zero."""
        return {"zero_ticks": [0] * self.n_tendons, "metres_per_tick": self.resolution}

    def restore(self, zero: Mapping[str, object]) -> None:
        """Nothing to take up: an arm that begins anew hangs on its stand.

        Raises:
            DataError: It is of other motors.
        """
        if zero != self.calibrate():
            raise DataError(f"the calibration has the motors {dict(zero)}, the settings {self.calibrate()}")

    def arm(self) -> None:
        """Torque on, with every goal at the present length."""
        y = self._ticks(self.read().y) * self.resolution
        with self.world.locked() as board:
            board.memory["goal"] = y
            board.memory["mode"] = Mode.POWERED

    def read(self) -> TendonReading:
        """The tendons as their encoders have them now.

        Raises:
            CommunicationError: The arm is gone.
            DeviceFaultError: The arm has left its bounds.
        """
        with self.world.locked() as board:
            stamp, y, ydot, effort = board.tendons(self.world.clock.now())
            diverged = bool(board.memory["diverged"])
        if diverged:
            raise DeviceFaultError("the simulated arm diverged")
        ticks = self._ticks(y)
        return TendonReading(stamp, ticks * self.resolution, ydot, effort, {"position": ticks.astype(int).tolist()})

    def rounded(self, y: Array, low: Array, high: Array) -> Array:
        """The nearest whole ticks from low to high, (n_a,) m each."""
        least, greatest = np.ceil(low / self.resolution - ROUND_OFF), np.floor(high / self.resolution + ROUND_OFF)
        return np.clip(self._ticks(y), least, greatest) * self.resolution

    def send(self, y: Array) -> Array:
        """Sets the goals (n_a,), m; returns them in whole ticks.

        Raises:
            HardwareError: The motors have no torque.
        """
        sent = self._ticks(y) * self.resolution
        with self.world.locked() as board:
            if board.memory["mode"] != Mode.POWERED:
                raise HardwareError("a goal was sent to motors without torque")
            board.memory["goal"] = sent
        return sent

    def hold(self) -> None:
        """Keeps the present lengths."""
        y = self._ticks(self.read().y) * self.resolution
        with self.world.locked() as board:
            board.memory["goal"] = y

    def torque_off(self) -> None:
        """Lets go. Motors that were never armed stay on their stand."""
        if not self.world.is_open:
            return
        try:
            with self.world.locked() as board:
                if board.memory["mode"] == Mode.POWERED:
                    board.memory["mode"] = Mode.LIMP
        except CommunicationError:
            # An arm whose process is gone has no torque.
            return

    def disconnect(self) -> None:
        """Torque off, and the arm's time ends."""
        self.torque_off()
        self.world.close("actuator")

    def _ticks(self, y: Array) -> Array:
        return np.rint(y / self.resolution)


class SimulatedRegulators(SimulatedActuator, PressureActuator):
    """The same for chambers: pressures in whole steps, which the simulated valves follow."""

    def __init__(self, world: SimulatedWorld, *given: Any, **changes: Any) -> None:
        super().__init__(world, *given, **changes)
        self.resolution = resolved(SimulatedActuatorSettings, given, changes).pressure_resolution

    def calibrate(self) -> dict[str, object]:
        """Nothing is measured: a gauge has its own zero."""
        return {"pascal_per_step": self.resolution}
