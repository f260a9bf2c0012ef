"""Tendons on servos: lengths in metres above, ticks on the bus below, and nothing sent outside the limits."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from apcc_torch.errors import CommunicationError, DataError, DeviceFaultError, HardwareError, SafetyError
from apcc_torch.hardware.interfaces import Array, TendonActuator, TendonReading
from apcc_torch.hardware.servos.bus import raise_all
from apcc_torch.hardware.servos.motors import ServoMotors, ServoStatus
from apcc_torch.hardware.servos.settings import ServoSettings
from apcc_torch.hardware.servos.spool import TICKS_PER_TURN, Spools, Ticks
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)

JUMP = TICKS_PER_TURN / 8  # ticks beyond the fastest motion that are no motion


class ServoActuator(TendonActuator):
    """The tendons' motors on one bus. Not for use from two threads at once.

    Args:
        settings: Port, motors, spools, limits.
        motors: All motors of the bus; those of the tendons are `settings.ids`.
    """

    lasting = ("ids", "spool_radii", "signs")

    def __init__(self, settings: ServoSettings, motors: ServoMotors) -> None:
        self.settings = settings
        self.n_tendons = len(settings.ids)
        self.motors = motors
        self.bus = motors.bus
        self.spools: Spools | None = None
        self._lost: set[int] = set()  # ids whose zero holds no more
        self._last: tuple[float, Ticks] | None = None

    def connect(self) -> None:
        """Opens the port, checks every motor and sets it up; torque stays off, and lengths have no zero yet.

        Raises:
            CommunicationError: The port cannot be opened, or a motor does not answer well.
            DeviceFaultError: A motor reports a hardware error, or refuses a setting.
            HardwareError: A wrong model or firmware, a motor that holds torque already, or connected already.
        """
        if self.bus.is_open:
            raise HardwareError(f"{self.settings.port} is connected already: disconnect first")
        self.bus.open()
        self._forget_zero()
        try:
            self.motors.check()
            self.motors.configure()
            self.motors.check_status(self.motors.status())
        except BaseException:
            self.bus.close()
            raise

    def _require(self, armed: bool, doing: str) -> None:
        if not self.bus.is_open:
            raise HardwareError(f"connect before {doing}")
        if armed != self.motors.armed:
            raise HardwareError(f"{doing} needs the motors {'armed' if armed else 'without torque'}")

    def _zeroed(self) -> Spools:
        if self.spools is None:
            raise HardwareError("tendon lengths have no zero: calibrate, or restore a calibration")
        if self._lost:
            names = ", ".join(self.bus.name(motor) for motor in sorted(self._lost))
            raise HardwareError(f"{names} lost its zero: calibrate again")
        return self.spools

    def _forget_zero(self) -> None:
        self.spools = None
        self._lost.clear()
        self._last = None

    def _spools(self, zero: Ticks) -> Spools:
        s = self.settings
        return Spools(
            radii=np.array(s.each("spool_radii"), dtype=np.float64),
            signs=np.array(s.each("signs"), dtype=np.int64),
            lower=np.array(s.each("lower"), dtype=np.float64),
            upper=np.array(s.each("upper"), dtype=np.float64),
            zero=zero,
            farthest=self.motors.farthest,
        )

    def calibrate(self) -> dict[str, object]:
        """Takes the present lengths as zero, the arm hanging at rest, and marks the motors with this calibration.

        Returns:
            ids, zero_ticks, spool_radii (m), signs, and the mark; what `restore` takes.

        Raises:
            HardwareError: Torque is on, or a motor does not answer or has a fault.
        """
        self._require(armed=False, doing="calibrating")
        self._forget_zero()
        status = self._status()
        zero = self._positions(status)
        spools = self._spools(zero)
        mark = self.motors.leave_mark()
        self.spools = spools
        return {key: self.settings.each(key) for key in self.lasting} | {"zero_ticks": zero.tolist(), "mark": mark}

    def restore(self, zero: Mapping[str, object]) -> None:
        """Takes up what `calibrate` returned, also in an earlier process, if the motors had power ever since.

        Raises:
            DataError: It is of other motors or spools.
            HardwareError: A motor has restarted since; or torque is on.
        """
        self._require(armed=False, doing="restoring a calibration")
        for key in self.lasting:
            if zero.get(key) != (mine := self.settings.each(key)):
                raise DataError(f"the calibration has {key} {zero.get(key)}, the settings {mine}: calibrate again")
        ticks, mark = zero.get("zero_ticks"), zero.get("mark")
        if not isinstance(ticks, list) or len(ticks) != self.n_tendons or not isinstance(mark, int):
            raise DataError("the calibration has no zero_ticks or no mark")
        self._forget_zero()
        self.motors.check_mark(mark)
        self._status()
        self.spools = self._spools(np.array(ticks, dtype=np.int64))

    def _positions(self, status: Mapping[int, ServoStatus]) -> Ticks:
        return np.array([status[motor].position for motor in self.settings.ids], dtype=np.int64)

    def _status(self) -> Mapping[int, Any]:
        """All motors, checked for faults and for jumps; after a restart or a jump lengths have no zero any more."""
        status = self.motors.status()
        now, positions = time.monotonic(), self._positions(status)
        self._lost.update(motor for motor, state in status.items() if state.restarted)
        self.motors.check_status(status)
        if self._last is not None:
            jump = np.abs(positions - self._last[1])
            beyond = jump - self.motors.fastest * (now - self._last[0])
            if (beyond > JUMP).any():
                self._last = None
                k = int(beyond.argmax())
                self._lost.add(motor := self.settings.ids[k])
                name = self.bus.name(motor)
                raise DeviceFaultError(f"{name} jumped by {jump[k]} ticks and lost its zero: calibrate again")
        self._last = (now, positions)
        return status

    def arm(self) -> None:
        """Torque on with every goal at the present length, read back.

        A tendon that is out of its range by less than `zero_tolerance` goes to the range's end.

        Raises:
            CommunicationError: A motor does not answer; all are without torque.
            DeviceFaultError: A motor refuses or has a fault; all are without torque.
            HardwareError: Not connected, not calibrated, or armed already.
            SafetyError: A tendon is out of its range by more than `zero_tolerance`.
        """
        self._require(armed=False, doing="arming")
        spools = self._zeroed()
        status = self._status()
        present = self._positions(status)
        y, goals = spools.length(present), spools.clip(present)
        out = np.abs(y - spools.length(goals)) > self.settings.zero_tolerance
        if out.any():
            k = int(out.argmax())
            limits = f"{1e3 * spools.lower[k]:g} to {1e3 * spools.upper[k]:g} mm"
            name = self.bus.name(self.settings.ids[k])
            raise SafetyError(f"the tendon of {name} is at {1e3 * y[k]:.1f} mm, outside {limits}: calibrate again")
        targets = dict(zip(self.settings.ids, goals.tolist(), strict=True))
        self.motors.arm(targets | self._other_goals(status))

    def _other_goals(self, status: Mapping[int, Any]) -> dict[int, int]:
        """Where motors that are no tendon's are held when torque goes on, in ticks."""
        return {}

    def read(self) -> TendonReading:
        """The tendons as they are now.

        Tensions are estimates, since friction in the gears is in them; 0 where a motor does not tell.

        Raises:
            CommunicationError: A motor did not answer well.
            DeviceFaultError: A motor reports an error, lost its torque, restarted, or stopped by itself.
            HardwareError: Not connected, or no zero.
        """
        spools = self._zeroed()
        ids = self.settings.ids
        before = time.monotonic()
        status = self._status()
        stamp = 0.5 * (before + time.monotonic())
        rows = [status[motor]._asdict() for motor in ids]
        raw = {name: [row[name] for row in rows] for name in rows[0]}
        return TendonReading(
            stamp=stamp,
            y=spools.length(self._positions(status)),
            ydot=spools.rate(self.motors.speeds(status, ids)),
            effort=spools.tension(self.motors.torques(status, ids)),
            raw=raw,
        )

    def rounded(self, y: Array, low: Array, high: Array) -> Array:
        """The lengths (n_a,) of the ticks nearest to y, from low to high and within the limits, m."""
        spools = self._zeroed()
        return spools.length(spools.clip(np.clip(spools.ticks(y), *spools.between(low, high))))

    def send(self, y: Array) -> Array:
        """Goals for all tendons in one packet, within the limits and in whole ticks; returns what was sent, m.

        Motors do not answer it: one that refuses shows in the next `read`.

        Raises:
            ShapeError, ValueRangeError: y is not n_tendons finite numbers; nothing is sent.
            CommunicationError: The packet could not be sent.
            HardwareError: Not armed.
        """
        self._require(armed=True, doing="sending")
        spools = self._zeroed()
        ticks = spools.ticks(y)
        self.motors.write_goals(dict(zip(self.settings.ids, ticks.tolist(), strict=True)))
        return spools.length(ticks)

    def hold(self) -> None:
        """Goals at the present lengths, within the limits; torque stays.

        Motors that do not answer or lost their zero keep their last goal. The others are held before the error is
        raised.

        Raises:
            CommunicationError: A motor did not answer.
            DeviceFaultError: A motor has a fault, as in `read`.
            HardwareError: Not armed.
        """
        self._require(armed=True, doing="holding")
        status, missing = self.motors.reachable()
        self._lost.update(motor for motor, state in status.items() if state.restarted)
        if self.spools is not None:
            sound = [motor in status and motor not in self._lost for motor in self.settings.ids]
            ticks = self.spools.zero.copy()
            ticks[sound] = [status[motor].position for motor, fit in zip(self.settings.ids, sound, strict=True) if fit]
            goals = zip(self.settings.ids, self.spools.clip(ticks).tolist(), sound, strict=True)
            self.motors.write_goals({motor: goal for motor, goal, fit in goals if fit}, hold=True)
        raise_all(missing.values())
        self.motors.check_status(status)
        self._zeroed()

    def torque_off(self) -> None:
        """Lets go of every motor; none is left out because another fails. Does nothing while not connected.

        A motor that cannot be reached keeps its torque.

        Raises:
            CommunicationError: Every motor was tried, and these did not confirm it.
        """
        if not self.bus.is_open:
            return
        if left := self.motors.torque_off():
            names = ", ".join(self.bus.name(motor) for motor in left)
            raise CommunicationError(f"torque off is not confirmed by {names}: cut the power")

    def disconnect(self) -> None:
        """Torque off, then closes the port. Never raises: what failed is in the log."""
        try:
            self.torque_off()
        except HardwareError as error:
            log.error("%s", error)
        self.bus.close()
        self._forget_zero()
