"""From frames to samples: the order of frames, the clocks, the gate and the base frame. It knows no network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from apcc_torch.errors import HardwareError
from apcc_torch.hardware.interfaces import Array, PoseSample
from apcc_torch.hardware.mocap.bodies import BodyPose, Frame
from apcc_torch.hardware.mocap.clock import ClockMap
from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.mocap.frames import BaseFrame, pose_distance
from apcc_torch.hardware.mocap.gate import BodyGate, Reason
from apcc_torch.hardware.mocap.settings import MocapSettings

_TICK = 1e-6  # s: the least difference of two samples' stamps


@dataclass(frozen=True)
class MocapSample(PoseSample):
    """A sample that also says why a body is not valid, in the order of the configured bodies, and of the base."""

    reasons: tuple[Reason, ...]
    base_reason: Reason


def readonly(values: Array) -> Array:
    """The array, which from now on cannot be written to."""
    values.setflags(write=False)
    return values


class Tracker:
    """Turns frames into samples; first it must be told the bodies' ids by `begin`.

    Args:
        settings: The sensor's settings.
        counts: Where frames and refused bodies are counted.
        base: The arm's base frame in the cameras' z-up world, m, (4, 4), from an earlier measurement; None: a static
            base is measured from the first frames, one that moves is taken from each frame.
    """

    def __init__(self, settings: MocapSettings, counts: Counts, base: Array | None = None) -> None:
        self._settings, self._counts = settings, counts
        self._frame = BaseFrame(settings)
        self._gate = BodyGate(len(settings.names), settings)
        # One map for each kind of stamp: their clocks do not begin at the same time.
        self._clocks = [
            ClockMap(settings.max_drift, settings.clock_step, settings.recovery_frames) for _ in ("software", "ticks")
        ]
        self.base = None if base is None else readonly(np.array(base, dtype=np.float64))
        self.base_error: HardwareError | None = None
        self.repeats = 0  # of the last frame number
        self._ids: list[int] = []
        self._rest: list[Array] = []  # the base body's poses while a static base is measured
        self._base_moved = 0
        self._sequence: int | None = None
        self._stamp = -np.inf
        self._older: int | None = None  # the last of some frames in a row with lower numbers
        self._older_streak = 0

    def update(self, frame: Frame, tick_rate: int, arrival: float) -> MocapSample | None:
        """Takes a frame in.

        Args:
            frame: The frame.
            tick_rate: Ticks per second of the server's stamps.
            arrival: When the frame came, monotonic s.

        Returns:
            The sample, or None for a frame that is no newer than the last.
        """
        if not self._is_newer(frame.sequence):
            return None
        stamp = self._stamped(frame, tick_rate, arrival)
        bodies = [self._scaled(frame.bodies.get(number)) for number in self._ids]
        reasons = self._gate.judge(bodies, stamp)
        T = self._world(bodies, reasons)
        base, reasons[0] = self._base_of(T[0], reasons[0])
        late = arrival - stamp > self._settings.max_age
        self._counts.late += late
        for i in range(1, len(reasons)):
            if late:
                reasons[i] = Reason.LATE
            elif reasons[i] is Reason.OK and reasons[0] is not Reason.OK:
                reasons[i] = Reason.BASE
        self._count(reasons)
        return self._sample(frame.sequence, stamp, T, base, reasons)

    def begin(self, ids: Mapping[str, int]) -> None:
        """Begins a stream: takes the bodies' streaming ids by name.

        Where it is not the first stream, its clock and its frame numbers may be others, and a body must first prove
        itself again.
        """
        if self._ids:
            self._renew()
            self._sequence = None
        self._ids = [ids[name] for name in self._settings.names]

    def _is_newer(self, sequence: int) -> bool:
        """Whether the frame follows the last one; a source that has begun anew is followed after a few frames."""
        last = self._sequence
        if last is None or sequence > last:
            self._counts.missed += 0 if last is None else sequence - last - 1
        elif sequence == last:
            self._counts.repeated += 1
            self.repeats += 1
            return False
        else:
            rising = self._older is not None and sequence > self._older
            self._older, self._older_streak = sequence, self._older_streak + 1 if rising else 1
            if self._older_streak < self._settings.recovery_frames:
                self._counts.out_of_order += 1
                return False
            self._counts.restarts += 1
            self._renew()
        self._sequence, self._older, self._older_streak, self.repeats = sequence, None, 0, 0
        return True

    def _renew(self) -> None:
        self._gate.distrust()
        for clock in self._clocks:
            clock.reset()

    def _stamped(self, frame: Frame, tick_rate: int, arrival: float) -> float:
        measured, sent, ticks = frame.times(tick_rate)
        clock = self._clocks[ticks]
        before = clock.steps
        clock.update(sent, arrival)
        self._counts.clock_steps += clock.steps - before
        stamp = clock.stamp(measured, arrival) - self._settings.latency
        # A better estimate of the clocks may lie earlier: samples' stamps still never go back.
        self._stamp = max(stamp, self._stamp + _TICK)
        return self._stamp

    def _scaled(self, body: BodyPose | None) -> BodyPose | None:
        if body is None or self._settings.scale == 1.0:
            return body
        x, y, z = (self._settings.scale * value for value in body.position)
        return BodyPose((x, y, z), body.quaternion, body.tracked)

    def _world(self, bodies: list[BodyPose | None], reasons: list[Reason]) -> Array:
        """Poses in the z-up world (n, 4, 4), NaN where a body is not valid."""
        T = np.full((len(bodies), 4, 4), np.nan)
        good = [i for i, reason in enumerate(reasons) if reason is Reason.OK]
        good_bodies = [body for i in good if (body := bodies[i]) is not None]
        if good_bodies:
            positions = np.array([body.position for body in good_bodies])
            T[good] = self._frame.world(positions, np.array([body.quaternion for body in good_bodies]))
        return T

    def _base_of(self, body: Array, reason: Reason) -> tuple[Array | None, Reason]:
        """The arm's base frame in the world, and whether it is to be believed."""
        if not self._settings.static_base:
            self.base = readonly(self._frame.base(body)) if reason is Reason.OK else None
            return self.base, reason
        if self.base is None:
            return self._measured_base(body, reason)
        if reason is Reason.OK:
            far, turned = pose_distance(self._frame.base(body), self.base)
            s = self._settings
            moved = far > s.base_position_tolerance or turned > s.base_angle_tolerance
            self._base_moved = self._base_moved + 1 if moved else 0
        return self.base, Reason.BASE if self._base_moved >= self._settings.recovery_frames else Reason.OK

    def _measured_base(self, body: Array, reason: Reason) -> tuple[Array | None, Reason]:
        if reason is not Reason.OK:
            return None, reason
        self._rest.append(body)
        if len(self._rest) >= self._settings.base_frames:
            try:
                self.base, self.base_error = readonly(self._frame.measure(np.array(self._rest), self._settings)), None
            except HardwareError as error:  # said by whoever waits for the base; the next frames try again
                self.base_error = error
            self._rest = []
        return self.base, Reason.BASE if self.base is None else Reason.OK

    def _count(self, reasons: list[Reason]) -> None:
        self._counts.frames += 1
        for name, reason in zip(self._settings.names, reasons, strict=True):
            if reason is not Reason.OK:
                self._counts.reject(name, reason.name.lower())

    def _sample(self, sequence: int, stamp: float, T: Array, base: Array | None, reasons: list[Reason]) -> MocapSample:
        """The sample of a frame; `T` and `reasons` are of the base, then of the bodies."""
        valid = np.array([reason is Reason.OK for reason in reasons[1:]])
        relative = np.full_like(T[1:], np.nan)
        if base is not None and valid.any():
            relative[valid] = self._frame.relative(base, T[1:][valid])
        valid.setflags(write=False)
        return MocapSample(stamp, sequence, readonly(relative), valid, tuple(reasons[1:]), reasons[0])
