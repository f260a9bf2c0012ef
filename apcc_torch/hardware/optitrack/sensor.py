"""`OptiTrackSensor`: poses of rigid bodies from a NatNet stream, in the arm's base frame, gated and time-stamped."""

from __future__ import annotations

import dataclasses
import threading
import time

import numpy as np

from apcc_torch.errors import CommunicationError, HardwareError, ValueRangeError
from apcc_torch.hardware.interfaces import Array, PoseSensor, check_library
from apcc_torch.hardware.optitrack import packets
from apcc_torch.hardware.optitrack.counts import Counts
from apcc_torch.hardware.optitrack.frames import check_pose
from apcc_torch.hardware.optitrack.gate import Reason
from apcc_torch.hardware.optitrack.limited_log import LimitedLog
from apcc_torch.hardware.optitrack.receiver import Receiver
from apcc_torch.hardware.optitrack.settings import OptiTrackSettings
from apcc_torch.hardware.optitrack.tracker import OptiTrackSample, Tracker, readonly
from apcc_torch.plain_text import plain_logger

_ASK_AGAIN = 0.2  # s between two requests that the server has not answered


class OptiTrackSensor(PoseSensor):
    """Motion capture by OptiTrack.

    A thread of its own receives the stream and keeps the newest sample. Its stamps are those of the middle of the
    exposure where the server tells it, else of the server's software stamp, in `time.monotonic()`. A sample's bodies
    are valid as the gate judges them; a sample that has grown older than `max_age` is handed out with none valid.

    Args:
        settings: Addresses, bodies, axes and limits.
        base: The arm's base frame in Motive's z-up world, m, (4, 4), as `base` had it in an earlier session; a base
            body that is not there is then noticed. None: a static base is measured when connecting.

    Raises:
        ShapeError: `base` does not have shape (4, 4).
        ValueRangeError: `base` is not a pose, or is given where the base is not static.
    """

    settings_type = OptiTrackSettings
    lasting = ("base", "bodies", "up", "scale", "base_offset", "base_quaternion")

    def __init__(self, settings: OptiTrackSettings, base: Array | None = None) -> None:
        check_library("natnet", type(self).__name__)
        if base is not None:
            check_pose("base", base)
            if not settings.static_base:
                raise ValueRangeError("base must not be given where static_base is false")
        self.settings = settings
        self.n_bodies = len(settings.bodies)
        self._given_base = base
        self._changed = threading.Condition()
        self._counting = threading.Lock()
        self._log = LimitedLog(plain_logger(__name__))
        self._forget()

    def _forget(self) -> None:
        """The state before connecting."""
        self._counts = Counts()
        self._tracker = Tracker(self.settings, self._counts, self._given_base)
        self._receiver = Receiver(self.settings, self._counts, self._take, self._tend)
        self._server: packets.Server | None = None
        self._ids: dict[str, int] | None = None
        self._refusal: str | None = None  # why this server cannot be used
        self._sample: OptiTrackSample | None = None
        self._last_frame = time.monotonic()  # the arrival of the last new frame
        self._last_answer = self._last_frame  # the arrival of the last model definitions
        self._greeted = False  # whether the server's version is known, and known to be a good one
        self._next_request = self._next_keepalive = 0.0

    def connect(self) -> None:
        """Opens the stream: checks the version and the bodies' names, and measures a static base.

        Raises:
            CommunicationError: No server answers, or nothing is streamed.
            HardwareError: The version is not known, a body is not there, or the base cannot be measured.
        """
        if self._receiver.running:
            raise HardwareError("the motion capture is already connected")
        self._forget()
        self._receiver.open()
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
        self._receiver.close()
        with self._changed:
            self._changed.notify_all()

    def latest(self) -> OptiTrackSample | None:
        """The newest sample, None before the first; never waits.

        Raises:
            CommunicationError: No new frame has come for `timeout`.
            HardwareError: It is not connected, or the server has come back as one that is refused.
        """
        if not self._receiver.running:
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

    def wait(self, timeout: float, after: int | None = None) -> OptiTrackSample | None:
        """The first sample newer than frame `after`, or None after `timeout` s.

        Raises:
            HardwareError: As `latest`, where there is such a sample or the server is refused.
        """

        def over() -> bool:
            newer = self._sample is not None and self._sample.sequence != after
            return newer or self._refusal is not None or not self._receiver.running

        with self._changed:
            done = self._changed.wait_for(over, timeout)
        return self.latest() if done else None

    @property
    def names(self) -> tuple[str, ...]:
        """Motive's names of the bodies, from the base to the tip."""
        return tuple(self.settings.bodies)

    @property
    def base(self) -> Array | None:
        """The arm's base frame in Motive's z-up world, m, (4, 4), read-only; None where it is not known."""
        return self._tracker.base

    @property
    def server(self) -> packets.Server | None:
        """What the server says of itself; None before it has answered."""
        return self._server

    @property
    def addresses(self) -> list[tuple[str, int]]:
        """What is listened on: address and port of each socket."""
        return self._receiver.addresses

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
            s = self.settings
            what = "names its rigid bodies" if self._server else "answers"
            raise CommunicationError(
                f"no NatNet server {what} at {s.server}:{s.command_port} within {s.connect_timeout:g} s"
            )

    def _wait_for_base(self) -> None:
        with self._changed:
            done = self._changed.wait_for(
                lambda: self._tracker.base is not None or self._refusal is not None, self.settings.connect_timeout
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

    def _stale(self, sample: OptiTrackSample) -> OptiTrackSample:
        nothing = np.zeros_like(sample.valid)
        nothing.setflags(write=False)
        reasons = (Reason.LATE,) * self.n_bodies
        return dataclasses.replace(sample, T=readonly(np.full_like(sample.T, np.nan)), valid=nothing, reasons=reasons)

    # From here on: called in the receiver's thread.

    def _take(self, data: bytes, arrival: float) -> None:
        """Takes one of the server's datagrams."""
        message, buffer = packets.open_datagram(data)
        if message == packets.FRAME:
            self._take_frame(buffer, arrival)
        elif message == packets.SERVER_INFO:
            self._greet(packets.read_server(buffer))
        elif message == packets.MODEL and self._server is not None:
            self._learn(packets.read_body_ids(buffer, self._server.version, self.settings.names))
        else:
            self._counts.unexpected += 1

    def _greet(self, server: packets.Server) -> None:
        refusal = None
        try:
            packets.check_version(server)
        except HardwareError as error:
            refusal = str(error)
        with self._changed:
            self._server, self._ids, self._greeted = server, None, refusal is None
            # Only its names tell that a server is a good one again.
            self._refusal = refusal or self._refusal
            self._changed.notify_all()
        self._next_request = 0.0

    def _learn(self, bodies: list[tuple[str, int]]) -> None:
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

    def _take_frame(self, buffer: packets.BoundedBuffer, arrival: float) -> None:
        if self._server is None or self._ids is None:
            return  # before the server's names and version are known, or known again, a frame means nothing
        frame = packets.read_frame(buffer, self._server.version)
        restarts = self._counts.restarts
        with self._counting:
            sample = self._tracker.update(frame, self._server.tick_rate, arrival)
        if self._counts.restarts > restarts:
            self._lose("the frame numbers began anew")
        if sample is None:
            return
        with self._changed:
            self._sample, self._last_frame = sample, arrival
            self._changed.notify_all()

    def _lose(self, why: str) -> None:
        """Asks the server anew who it is: it may be another one, with other names for the same bodies."""
        self._log.warning("lost", "motion capture: %s", why)
        self._ids, self._greeted, self._next_request = None, False, 0.0

    def _tend(self, now: float) -> None:
        """Asks for what is not known yet, and tells a unicast server that we are here."""
        silent = now - max(self._last_frame, self._last_answer) > self.settings.timeout
        if self._ids is not None and silent:
            self._counts.losses += self._last_frame > self._last_answer
            self._lose(f"no new frame for {self.settings.timeout:g} s")
        if self._ids is None and now >= self._next_request:
            self._next_request = now + _ASK_AGAIN
            self._receiver.send(packets.request(packets.REQUEST_MODEL if self._greeted else packets.CONNECT))
        if not self.settings.multicast and now >= self._next_keepalive:
            self._next_keepalive = now + self.settings.keepalive
            self._receiver.send(packets.request(packets.KEEPALIVE))
