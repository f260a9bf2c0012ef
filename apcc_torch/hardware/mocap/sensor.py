"""`MocapSensor`: poses of rigid bodies from a stream of frames, in the arm's base frame, gated and time-stamped."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from apcc_torch.errors import CommunicationError, HardwareError, ValueRangeError
from apcc_torch.hardware.interfaces import Array, PoseSensor, check_library
from apcc_torch.hardware.mocap.bodies import Frame
from apcc_torch.hardware.mocap.counts import Counts
from apcc_torch.hardware.mocap.frames import check_pose
from apcc_torch.hardware.mocap.gate import Reason
from apcc_torch.hardware.mocap.limited_log import LimitedLog
from apcc_torch.hardware.mocap.settings import MocapSettings
from apcc_torch.hardware.mocap.tracker import MocapSample, Tracker, readonly
from apcc_torch.plain_text import plain_logger


class MocapSensor(PoseSensor):
    """Motion capture of any make. A driver opens its stream in a thread of its own, and hands on names and frames.

    The newest sample is kept. Its stamps are those of the frame's measurement in `time.monotonic()`, as well as the
    stream tells it. A sample's bodies are valid as the gate judges them; a sample that has grown older than `max_age`
    is handed out with none valid.

    Args:
        settings: Bodies, axes and limits, and what the driver needs.
        base: The arm's base frame in the cameras' z-up world, m, (4, 4), as `base` had it in an earlier session; a base
            body that is not there is then noticed. None: a static base is measured when connecting.

    Attributes:
        library: The maker's library, without which there is no driver. server_name: What messages call the server.

    Raises:
        ShapeError: `base` does not have shape (4, 4).
        ValueRangeError: `base` is not a pose, or is given where the base is not static.
    """

    lasting = ("base", "bodies", "up", "scale", "base_offset", "base_quaternion")
    library: ClassVar[str]
    server_name: ClassVar[str]
    settings: MocapSettings

    def __init__(self, settings: MocapSettings, base: Array | None = None) -> None:
        check_library(self.library, type(self).__name__)
        if base is not None:
            check_pose("base", base)
            if not settings.static_base:
                raise ValueRangeError("base must not be given where static_base is false")
        self.settings = settings
        self.n_bodies = len(settings.bodies)
        self._given_base = base
        self._changed = threading.Condition()
        self._counting = threading.Lock()
        self._log = LimitedLog(self.log)
        self._forget()

    @property
    def log(self) -> logging.Logger:
        """Where warnings go."""
        return plain_logger(type(self).__module__)

    def _forget(self) -> None:
        """The state before connecting."""
        self._counts = Counts()
        self._tracker = Tracker(self.settings, self._counts, self._given_base)
        self._ids: dict[str, int] | None = None
        self._refusal: str | None = None  # why this server cannot be used
        self._sample: MocapSample | None = None
        self._base = self._tracker.base  # of the kept sample
        self._last_frame = time.monotonic()  # the arrival of the last new frame
        self._last_answer = self._last_frame  # the arrival of the last names
        self._next_request = 0.0

    @abstractmethod
    def _open(self) -> None:
        """Opens the stream; raises CommunicationError where it cannot."""

    @abstractmethod
    def _close(self) -> None:
        """Closes it, in any state."""

    @property
    @abstractmethod
    def _running(self) -> bool:
        """Whether it is open."""

    @property
    @abstractmethod
    def _where(self) -> str:
        """The server's address and port."""

    @property
    @abstractmethod
    def _answers(self) -> bool:
        """Whether the server has said anything of itself."""

    def connect(self) -> None:
        """Opens the stream: checks the version and the bodies' names, and measures a static base.

        Raises:
            CommunicationError: No server answers, or nothing is streamed.
            HardwareError: The version is not known, a body is not there, or the base cannot be measured.
        """
        if self._running:
            raise HardwareError("the motion capture is already connected")
        self._forget()
        self._open()
        try:
            self._wait_for_server()
            self._last_frame = time.monotonic()
            if self.settings.static_base and self._given_base is None:
                self._wait_for_base()
        except BaseException:
            self.disconnect()
            raise

    def disconnect(self) -> None:
        """Closes the stream. Safe to call in any state."""
        self._close()
        with self._changed:
            self._changed.notify_all()

    def latest(self) -> MocapSample | None:
        """The newest sample, None before the first; never waits.

        Raises:
            CommunicationError: No new frame has come for `timeout`.
            HardwareError: It is not connected, or the server has come back as one that is refused.
        """
        if not self._running:
            raise HardwareError("the motion capture is not connected")
        self._check_refusal()
        now = time.monotonic()
        silence = now - self._last_frame
        if silence > self.settings.timeout:
            raise CommunicationError(f"no new frame of motion capture for {silence:.2f} s: {self._why_silent()}")
        sample = self._sample
        if sample is None or now - sample.stamp <= self.settings.max_age or not sample.valid.any():
            return sample
        return self._stale(sample)

    def wait(self, timeout: float, after: int | None = None) -> MocapSample | None:
        """The first sample newer than frame `after`, or None after `timeout` s.

        Raises:
            HardwareError: As `latest`, where there is such a sample or the server is refused.
        """

        def over() -> bool:
            newer = self._sample is not None and self._sample.sequence != after
            return newer or self._refusal is not None or not self._running

        with self._changed:
            done = self._changed.wait_for(over, timeout)
        return self.latest() if done else None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the bodies, from the base to the tip."""
        return tuple(self.settings.bodies)

    @property
    def base(self) -> Array | None:
        """The arm's base frame in the cameras' z-up world, m, (4, 4), read-only; None where it is not known."""
        return self._base

    def counts(self) -> Counts:
        """What has been counted since connecting."""
        with self._counting:
            return self._counts.copy()

    def _check_refusal(self) -> None:
        if self._refusal is not None:
            raise HardwareError(self._refusal)

    def _wait_for_server(self) -> None:
        with self._changed:
            done = self._changed.wait_for(lambda: bool(self._ids or self._refusal), self.settings.connect_timeout)
        self._check_refusal()
        if not done:
            what = "names its rigid bodies" if self._answers else "answers"
            within = f"within {self.settings.connect_timeout:g} s"
            raise CommunicationError(f"no {self.server_name} {what} at {self._where} {within}")

    def _wait_for_base(self) -> None:
        with self._changed:
            done = self._changed.wait_for(
                lambda: self._base is not None or self._refusal is not None, self.settings.connect_timeout
            )
        self._check_refusal()
        if done:
            return
        if self._tracker.base_error is not None:
            raise self._tracker.base_error
        counts = self.counts()
        if counts.frames == 0:
            raise CommunicationError(f"the server streams no frames: {self._why_silent()}")
        raise HardwareError(
            f"the base body {self.settings.base!r} could not be measured in {counts.frames} frames: "
            f"not valid in {counts.bodies.get(self.settings.base, {})}"
        )

    def _why_silent(self) -> str:
        if self._tracker.repeats > 0:
            return f"the frame number stays at {self._sample.sequence if self._sample else 0}"
        c = self._counts
        return f"{c.packets} packets came in all, {c.malformed} of them damaged and {c.foreign} from others"

    def _stale(self, sample: MocapSample) -> MocapSample:
        nothing = np.zeros_like(sample.valid)
        nothing.setflags(write=False)
        reasons = (Reason.LATE,) * self.n_bodies
        return dataclasses.replace(sample, T=readonly(np.full_like(sample.T, np.nan)), valid=nothing, reasons=reasons)

    # From here on: called in the driver's thread.

    def _learn(self, bodies: Sequence[tuple[str, int]]) -> None:
        """Takes the stream's bodies, (name, number): frames count from now on, or the server is refused."""
        ids, refusal = dict(bodies), None
        names, numbers = [name for name, _ in bodies], [number for _, number in bodies]
        if missing := [name for name in self.settings.names if name not in ids]:
            refusal = f"the server has no rigid body {', '.join(missing)}; it has {', '.join(ids) or 'none'}"
        elif double := [name for name in self.settings.names if names.count(name) > 1]:
            refusal = f"the server has two rigid bodies named {', '.join(double)}"
        elif double := [name for name in self.settings.names if numbers.count(ids[name]) > 1]:
            refusal = f"the server has another rigid body with the streaming id of {', '.join(double)}"
        with self._changed:
            if refusal is not None:
                self._refusal, self._ids = refusal, None
            else:
                self._tracker.begin(ids)
                self._ids, self._refusal, self._last_answer = ids, None, time.monotonic()
            self._changed.notify_all()

    def _refuse(self, why: str) -> None:
        """The server cannot be used; only its names tell that it is a good one again."""
        with self._changed:
            self._refusal, self._ids = why, None
            self._changed.notify_all()

    def _track(self, frame: Frame, tick_rate: int, arrival: float) -> None:
        """Takes a frame of a server that is known."""
        restarts = self._counts.restarts
        with self._counting:
            sample = self._tracker.update(frame, tick_rate, arrival)
        if self._counts.restarts > restarts:
            self._lose("the frame numbers began anew")
        if sample is None:
            return
        with self._changed:
            # Together: who has waited for the base must not be handed a sample from before it.
            self._sample, self._base, self._last_frame = sample, self._tracker.base, arrival
            self._changed.notify_all()

    def _lose(self, why: str) -> None:
        """The server may be another one from now on, with other names for the same bodies: it is asked anew."""
        self._log.warning("lost", "motion capture: %s", why)
        self._ids, self._next_request = None, 0.0

    def _mind_silence(self, now: float) -> None:
        """Loses a server that has not sent a new frame for `timeout`."""
        silent = now - max(self._last_frame, self._last_answer) > self.settings.timeout
        if self._ids is not None and silent:
            self._counts.losses += self._last_frame > self._last_answer
            self._lose(f"no new frame for {self.settings.timeout:g} s")
