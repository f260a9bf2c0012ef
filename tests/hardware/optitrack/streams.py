"""Frames made in memory, in step with a clock of their own: for tests without a network."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from apcc_torch.hardware.mocap.bodies import BodyPose
from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.mocap.tracker import MocapSample, Tracker
from apcc_torch.hardware.optitrack.packets import Frame
from apcc_torch.hardware.optitrack.settings import OptiTrackSettings
from hardware.emulators.mocap_server import standing

NAMES = {1: "base", 2: "disk_1", 3: "disk_2", 4: "disk_3"}
IDS = {name: number for number, name in NAMES.items()}
RATE = 100.0
TICK_RATE = 10_000_000
EXPOSURE = 0.004  # s from the exposure to the transmission
TRANSPORT = 0.0002  # s from there to the arrival
SERVER_CLOCK = 5000.0  # s that the server's clock is ahead


def settings(**changes: object) -> OptiTrackSettings:
    given: dict[str, object] = {"base": "base", "bodies": ("disk_1", "disk_2", "disk_3"), "base_frames": 1}
    return OptiTrackSettings(**{**given, **changes})  # type: ignore[arg-type]


def body(row: np.ndarray, tracked: bool = True) -> BodyPose:
    return BodyPose(tuple(map(float, row[:3])), tuple(map(float, row[3:])), tracked)  # type: ignore[arg-type]


@dataclass
class Stream:
    """Feeds a tracker with one frame after another."""

    config: OptiTrackSettings = field(default_factory=settings)
    base: np.ndarray | None = None
    poses: np.ndarray = field(default_factory=lambda: standing(4))
    ticks: bool = True
    noise: float = 1e-5

    def __post_init__(self) -> None:
        self.counts = Counts()
        self.tracker = Tracker(self.config, self.counts, self.base)
        self.tracker.begin(IDS)
        self.random = np.random.default_rng(1)
        self.sequence, self.now = 0, 100.0
        self.clock_step = 0.0

    def frame(self, poses: np.ndarray | None = None, untracked: tuple[int, ...] = ()) -> Frame:
        """The next frame, 1 / RATE later; poses (k, 7), bodies by their number."""
        self.sequence, self.now = self.sequence + 1, self.now + 1.0 / RATE
        rows = (self.poses if poses is None else poses).copy()
        rows[:, :3] += self.random.normal(0.0, self.noise, (len(rows), 3)) if self.noise else 0.0
        bodies = {number: body(row, number not in untracked) for number, row in zip(NAMES, rows, strict=False)}
        stamp = self.now + SERVER_CLOCK + self.clock_step
        ticks = (round((stamp - EXPOSURE) * TICK_RATE), round(stamp * TICK_RATE)) if self.ticks else (0, 0)
        return Frame(self.sequence, bodies, stamp, *ticks)

    def take(self, frame: Frame, delay: float = TRANSPORT) -> MocapSample | None:
        """Hands a frame over, `delay` after it was sent."""
        return self.tracker.update(frame, TICK_RATE if self.ticks else 0, self.now + delay)

    def step(self, poses: np.ndarray | None = None, untracked: tuple[int, ...] = ()) -> MocapSample:
        """Makes the next frame and hands it over in time."""
        sample = self.take(self.frame(poses, untracked))
        assert sample is not None
        return sample

    def run(self, frames: int) -> MocapSample:
        """Some good frames."""
        for _ in range(frames):
            sample = self.step()
        return sample
