"""A source of poses of an arm that hangs still, fresh every time it is asked: a run goes on until something ends it."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from apcc_torch.hardware.interfaces import PoseSample, PoseSensor
from apcc_torch.settings import Settings, setting


@dataclass(frozen=True, kw_only=True)
class StillSettings(Settings):
    """Where its bodies are."""

    places: tuple[float, ...] = setting((0.145, 0.29), "m", meaning="of the bodies below the base")


class StillSensor(PoseSensor):
    """Poses of a straight hanging arm at 100 Hz."""

    settings_type = StillSettings

    def __init__(self, settings: StillSettings) -> None:
        self.places = settings.places
        self.n_bodies = len(settings.places)

    def connect(self) -> None:
        """Begins."""
        self.began = time.monotonic()

    def latest(self) -> PoseSample | None:
        """The frame of now."""
        sequence = int(100.0 * (time.monotonic() - self.began))
        T = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (self.n_bodies, 1, 1))
        # No two frames are the same to the bit, or they would be taken for frozen ones.
        T[:, 2, 3] = np.negative(self.places) + 1e-5 * np.sin(sequence)
        return PoseSample(self.began + sequence / 100.0, sequence, T, np.ones(self.n_bodies, dtype=bool))

    def wait(self, timeout: float, after: int | None = None) -> PoseSample | None:
        """The next frame."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            sample = self.latest()
            if sample is not None and (after is None or sample.sequence > after):
                return sample
            time.sleep(0.002)
        return None

    def disconnect(self) -> None:
        """Ends."""
