"""The motion capture of the simulated arm."""

from __future__ import annotations

from apcc_torch.hardware.interfaces import PoseSample, PoseSensor
from apcc_torch.hardware.simulated.world import World

POLL = 1e-3
"""How often `wait` looks, s."""


class SimulatedSensor(PoseSensor):
    """Frames at a fixed rate that arrive a latency after they were measured.

    Args:
        world: Where the arm lives.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.n_bodies = world.arm.n_bodies
        self.latency = world.arm.settings.frame_latency

    def connect(self) -> None:
        """Begins the arm's time, if the actuator has not."""
        self.world.open("sensor")

    def latest(self) -> PoseSample | None:
        """The newest frame that has arrived.

        Raises:
            CommunicationError: The arm is gone.
        """
        with self.world.locked() as board:
            return board.frame(self.world.clock.now() - self.latency)

    def wait(self, timeout: float, after: int | None = None) -> PoseSample | None:
        """The first sample newer than frame `after`, or None after `timeout` s."""
        clock = self.world.clock
        end = clock.now() + timeout
        while True:
            sample = self.latest()
            if sample is not None and (after is None or sample.sequence > after):
                return sample
            if clock.now() >= end:
                return None
            clock.wait_until(min(end, clock.now() + POLL))

    def disconnect(self) -> None:
        """Lets go of the arm."""
        self.world.close("sensor")
