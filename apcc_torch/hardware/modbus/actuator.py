"""Chambers on proportional pressure regulators: pascals above, counts of registers below, none outside the limits."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np

from apcc_torch.errors import (
    CommunicationError,
    DataError,
    DeviceFaultError,
    HardwareError,
    SafetyError,
    ShapeError,
    ValueRangeError,
)
from apcc_torch.hardware.interfaces import Array, PressureActuator, TendonReading, check_library
from apcc_torch.hardware.modbus.link import ModbusLink
from apcc_torch.hardware.modbus.settings import LAST, RegulatorSettings
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)


class ModbusRegulators(PressureActuator):
    """The regulators of an arm's chambers. Not for use from two threads at once.

    After `arm` the units' own watchdog runs, where they have one: without a request in `watchdog` seconds they vent.
    """

    settings_type = RegulatorSettings
    lasting = ("units", "commands", "readings")

    def __init__(self, settings: RegulatorSettings) -> None:
        check_library("pymodbus", type(self).__name__, "modbus")
        self.settings = settings
        self.n_tendons = len(settings.commands)
        self.link = ModbusLink(settings.host, settings.port, settings.reply_timeout)
        self.units = settings.each_unit()
        self.lower, self.upper = settings.each("lower").numpy(), settings.each("upper").numpy()
        self.scale, self.reading_scale = settings.each("command_scale").numpy(), settings.each("reading_scale").numpy()
        self.armed = False
        self.beat = 0
        self._last: tuple[float, Array] | None = None

    def _each_unit(self) -> dict[int, list[int]]:
        """The chambers of every unit, from 0."""
        return {unit: [k for k, of in enumerate(self.units) if of == unit] for unit in dict.fromkeys(self.units)}

    def connect(self) -> None:
        """Opens the connection and checks every unit; nothing is commanded.

        Raises:
            CommunicationError: Nobody answers, or not well.
            DeviceFaultError: A unit reports a fault.
            HardwareError: A unit is of another kind, or connected already.
        """
        s = self.settings
        if self.link.is_open:
            raise HardwareError(f"{self.link.where} is connected already: disconnect first")
        self.link.open()
        self.armed, self._last = False, None
        try:
            for unit in self._each_unit():
                if s.identity is not None:
                    (found,) = self.link.read(unit, s.reading_table, [s.identity])
                    if found != s.kind_number:
                        raise HardwareError(f"unit {unit} at {self.link.where} is of kind {found}, not {s.kind_number}")
            self._pressures()
        except BaseException:
            self.link.close()
            raise

    def calibrate(self) -> dict[str, object]:
        """Which registers the chambers are on; a gauge has its own zero."""
        self._require(armed=False, doing="calibrating")
        return {key: list(getattr(self.settings, key)) for key in self.lasting}

    def restore(self, zero: Mapping[str, object]) -> None:
        """Checks that a calibration is of these registers.

        Raises:
            DataError: It is of others.
        """
        for key in self.lasting:
            if zero.get(key) != (mine := list(getattr(self.settings, key))):
                raise DataError(f"the calibration has {key} {zero.get(key)}, the settings {mine}: calibrate again")

    def _require(self, armed: bool, doing: str) -> None:
        if not self.link.is_open:
            raise HardwareError(f"connect before {doing}")
        if armed != self.armed:
            raise HardwareError(f"{doing} needs the regulators {'armed' if armed else 'without power'}")

    def _pressures(self) -> tuple[Array, list[int]]:
        """Measured pressures (n_a,), Pa, with their counts, of units without a fault."""
        s, counts = self.settings, [0] * self.n_tendons
        for unit, chambers in self._each_unit().items():
            addresses = [s.readings[k] for k in chambers]
            asked = addresses if s.status is None else [*addresses, s.status]
            values = self.link.read(unit, s.reading_table, asked)
            if s.status is not None and (bits := values[-1] & s.faults):
                raise DeviceFaultError(f"unit {unit} at {self.link.where} reports a fault: status bits {bits:#06x}")
            for k, value in zip(chambers, values, strict=False):
                counts[k] = value
        return self.reading_scale * np.array(counts, dtype=np.float64), counts

    def arm(self) -> None:
        """Sets the watchdog, commands the present pressures, and lets the outputs follow.

        Raises:
            CommunicationError: A unit does not answer well; what could be reached is vented.
            SafetyError: A pressure is out of its range by more than `settle_tolerance`.
            HardwareError: Not connected, or armed already.
        """
        self._require(armed=False, doing="arming")
        s, (present, _) = self.settings, self._pressures()
        out = np.maximum(self.lower - present, present - self.upper)
        if out.max() > s.settle_tolerance:
            k = int(out.argmax())
            limits = f"{1e-3 * self.lower[k]:g} to {1e-3 * self.upper[k]:g} kPa"
            raise SafetyError(f"chamber {k + 1} is at {1e-3 * present[k]:.1f} kPa, outside {limits}")
        self.armed = True
        try:
            self._write(self._counts(present))
            for unit in self._each_unit():
                if s.watchdog_register is not None:
                    counts = 0 if s.watchdog is None else round(s.watchdog / s.watchdog_unit)
                    self.link.write(unit, {s.watchdog_register: counts})
                if s.enable is not None:
                    self.link.write(unit, {s.enable: 1})
        except BaseException:
            self.torque_off()
            raise

    def read(self) -> TendonReading:
        """The pressures as they are now; nothing tells a tension.

        Raises:
            CommunicationError: A unit did not answer well.
            DeviceFaultError: A unit reports a fault.
        """
        if not self.link.is_open:
            raise HardwareError("connect before reading")
        before = time.monotonic()
        p, counts = self._pressures()
        stamp = 0.5 * (before + time.monotonic())
        rate = np.zeros_like(p)
        if self._last is not None and stamp > self._last[0]:
            rate = (p - self._last[1]) / (stamp - self._last[0])
        self._last = (stamp, p)
        return TendonReading(stamp, p, rate, np.zeros_like(p), {"pressure": counts})

    def _counts(self, p: Array) -> np.ndarray:
        """Counts of the commands nearest to p (n_a,), Pa, within the limits."""
        least, most = np.ceil(self.lower / self.scale - 1e-9), np.floor(self.upper / self.scale + 1e-9)
        return np.clip(np.rint(p / self.scale), least, most).astype(int)

    def rounded(self, y: Array, low: Array, high: Array) -> Array:
        """The pressures (n_a,) of the counts nearest to y, from low to high and within the limits, Pa."""
        least, most = np.ceil(low / self.scale - 1e-9), np.floor(high / self.scale + 1e-9)
        counts = np.clip(np.rint(y / self.scale), least, most)
        return self.scale * self._counts(self.scale * counts)

    def _write(self, counts: np.ndarray) -> None:
        s = self.settings
        self.beat = (self.beat + 1) % (LAST + 1)
        for unit, chambers in self._each_unit().items():
            values = {s.commands[k]: int(counts[k]) for k in chambers}
            self.link.write(unit, values if s.heartbeat is None else {**values, s.heartbeat: self.beat})

    def send(self, y: Array) -> Array:
        """Commands pressures (n_a,), Pa, within the limits and in whole counts; returns what was sent.

        Raises:
            ShapeError, ValueRangeError: y is not n_a finite numbers; nothing is sent.
            CommunicationError: A unit did not confirm it.
            HardwareError: Not armed.
        """
        self._require(armed=True, doing="sending")
        if np.shape(y) != (self.n_tendons,):
            raise ShapeError(f"pressures must have shape ({self.n_tendons},), got {np.shape(y)}")
        if not np.isfinite(y).all():
            raise ValueRangeError(f"pressures must be finite, got {y.tolist()}")
        counts = self._counts(y)
        self._write(counts)
        return self.scale * counts

    def hold(self) -> None:
        """Commands the present pressures.

        Raises:
            CommunicationError: A unit did not answer well.
            DeviceFaultError: A unit reports a fault.
            HardwareError: Not armed.
        """
        self._require(armed=True, doing="holding")
        self._write(self._counts(self._pressures()[0]))

    def torque_off(self) -> None:
        """Vents every chamber; none is left out because another fails. Does nothing where nothing was armed.

        Raises:
            CommunicationError: Every unit was tried, and these did not confirm it.
        """
        if not self.link.is_open or not self.armed:
            return
        s, left = self.settings, []
        for unit, chambers in self._each_unit().items():
            try:
                self.link.write(unit, {s.commands[k]: 0 for k in chambers})
                if s.enable is not None:
                    self.link.write(unit, {s.enable: 0})
            except CommunicationError as error:
                log.error("%s", error)
                left.append(unit)
        self.armed = bool(left)
        if left:
            names = ", ".join(f"unit {unit}" for unit in left)
            raise CommunicationError(f"venting is not confirmed by {names} at {self.link.where}: cut the supply")

    def disconnect(self) -> None:
        """Vents, then closes the connection. Never raises: what failed is in the log."""
        try:
            self.torque_off()
        except HardwareError as error:
            log.error("%s", error)
        self.link.close()
        self.armed = False
