"""The motion capture of the simulated arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

from apcc_torch.hardware.interfaces import PoseSample, PoseSensor
from apcc_torch.hardware.simulated.world import SimulatedWorld, simulated
from apcc_torch.hardware.world import World
from apcc_torch.settings import OURS, PAPER, Settings, resolved, setting

POLL = 1e-3
"""How often `wait` looks, s."""


@dataclass(frozen=True, kw_only=True)
class SimulatedSensorSettings(Settings):
    """What the simulated cameras are like."""

    rate: float = setting(50.0, "Hz", PAPER, "of the motion capture", above=0)
    latency: float = setting(8e-3, "s", OURS, "from a frame's measurement to its arrival", least=0)


class SimulatedSensor(PoseSensor):
    """Frames at a fixed rate that arrive a latency after they were measured."""

    settings_type = SimulatedSensorSettings

    def __init__(self, world: SimulatedWorld, *given: Any, **changes: Any) -> None:
        settings = resolved(SimulatedSensorSettings, given, changes)
        self.world = world
        self.n_bodies = world.arm.n_bodies
        self.latency = settings.latency
        world.arm.frame_rate = settings.rate

    @classmethod
    def in_world(cls, settings: Settings, world: World) -> Self:
        """The cameras around the world's arm."""
        return cls(simulated(world), settings)

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
