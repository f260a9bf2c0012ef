"""The motors of the simulated arm."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from apcc_torch.errors import CommunicationError, DataError, DeviceFaultError, HardwareError
from apcc_torch.hardware.interfaces import Array, TendonActuator, TendonReading
from apcc_torch.hardware.simulated.board import Mode
from apcc_torch.hardware.simulated.world import World


class SimulatedActuator(TendonActuator):
    """Tendons on simulated motors: whole encoder ticks, bounded speed, compliance, and torque that can be off.

    Args:
        world: Where the arm lives.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.n_tendons = world.arm.n_tendons
        self.resolution = world.arm.settings.resolution

    def connect(self) -> None:
        """Begins the arm's time; it hangs on its stand."""
        self.world.open("actuator")

    def calibrate(self) -> dict[str, object]:
        """Nothing to find: the stand holds the tendons at zero."""
        return {"zero_ticks": [0] * self.n_tendons, "metres_per_tick": self.resolution}

    def restore(self, found: Mapping[str, object]) -> None:
        """Nothing to take up: an arm that begins anew hangs on its stand.

        Raises:
            DataError: It is of other motors.
        """
        if found != self.calibrate():
            raise DataError(f"the calibration has the motors {dict(found)}, the settings {self.calibrate()}")

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
