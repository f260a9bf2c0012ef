"""What the runner needs of motors and of a motion-capture system: SI units, monotonic stamps, one vocabulary.

A driver is a class of its own: `hardware.actuator.kind` and `hardware.sensor.kind` name it, and `settings_type` is the
class of its settings. It may import its maker's library where it stands; `check_library` says what is missing.

Tendon length changes follow y = B^T q: negative where a tendon is pulled in, zero at the calibrated zero of the hanging
arm. Stamps are `time.monotonic()` seconds. The pressures of chambers go the same way, see `PressureActuator`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from types import TracebackType
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from apcc_torch.errors import ConfigError
from apcc_torch.hardware.world import World
from apcc_torch.part import Configurable

Array = NDArray[np.float64]


class Device(Configurable, ABC):
    """Something to connect to; `with` connects, and disconnects on every exit.

    Attributes:
        lasting: Settings that a calibration depends on: with others it does not hold.
    """

    lasting: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def in_world(cls, settings: Any, world: World) -> Self:
        """The device of these settings, not yet connected.

        Args:
            settings: Of this class.
            world: What it shares with the run's other device; one that is real needs nothing of it.
        """
        kind: Any = cls
        device: Self = kind(settings)
        return device

    @abstractmethod
    def connect(self) -> None:
        """Opens the device."""

    @abstractmethod
    def disconnect(self) -> None:
        """Closes the device. Safe to call in any state."""

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()


@dataclass(frozen=True)
class TendonReading:
    """One reading of all tendons.

    stamp: s, monotonic, when the values were sampled.
    y: (n_a,) m, length change; ydot: (n_a,) m/s; effort: (n_a,) N, tension estimated by the device (its current), or
    zeros where the device does not tell. raw: the device's own integers or registers, for the log.
    """

    stamp: float
    y: Array
    ydot: Array
    effort: Array
    raw: dict[str, list[int]]


class TendonActuator(Device):
    """Motors that set tendon lengths. `with` connects, and on every exit leaves the motors without torque.

    The order is connect, calibrate or restore, arm, then read and send; `hold` and `torque_off` end it. Every method
    raises a `HardwareError` subclass that says what is wrong and with which motor.

    Attributes:
        n_tendons: Number of tendons n_a.
        needs_calibration: Whether a run has to name a calibration.
        sets_pressure: Whether it is told pressures, Pa, and not lengths.
    """

    n_tendons: int
    needs_calibration: ClassVar[bool] = True
    sets_pressure: ClassVar[bool] = False

    @abstractmethod
    def connect(self) -> None:
        """Opens the device and checks that it is the one configured; torque stays off."""

    @abstractmethod
    def calibrate(self) -> dict[str, object]:
        """Takes the present lengths as zero; returns what `restore` needs, as plain values for a file."""

    @abstractmethod
    def restore(self, zero: Mapping[str, object]) -> None:
        """Takes up what `calibrate` returned, also in an earlier process; refuses what is not of this device."""

    @abstractmethod
    def arm(self) -> None:
        """Torque on, with every goal at the present length: nothing moves."""

    @abstractmethod
    def read(self) -> TendonReading:
        """The tendons as they are now."""

    def rounded(self, y: Array, low: Array, high: Array) -> Array:
        """The lengths (n_a,) nearest to y that the motors can be told, from low to high, m.

        Here y itself; motors that go in whole ticks say which, so that rounding does not leave a limit.
        """
        return y

    @abstractmethod
    def send(self, y: Array) -> Array:
        """Commands length changes (n_a,), m; returns what was really sent, after the device's own limits and ticks."""

    @abstractmethod
    def hold(self) -> None:
        """Keeps the present lengths under torque: the arm stays where it is."""

    @abstractmethod
    def torque_off(self) -> None:
        """Lets go: the arm drops. Safe to call in any state, twice, and on a broken connection."""

    @abstractmethod
    def disconnect(self) -> None:
        """Torque off, then closes the device. Safe to call in any state."""


class PressureActuator(TendonActuator):
    """Regulators that set the gauge pressures of chambers: p (n_a,) Pa stands wherever `TendonActuator` has lengths.

    `hold` keeps the pressures that there are. `torque_off` vents: every chamber is told no pressure, and the arm drops.
    Nothing has to be calibrated, for a gauge has its own zero: `calibrate` and `restore` take what tells the device.
    """

    needs_calibration: ClassVar[bool] = False
    sets_pressure: ClassVar[bool] = True


@dataclass(frozen=True)
class PoseSample:
    """One frame of the sensors.

    stamp: s, monotonic, when the frame was measured as well as it is known. sequence: The source's frame number.
    T: (k, 4, 4) poses in the arm's base frame, m, in the order of the configured bodies; NaN where not valid.
    valid: (k,) whether the body was tracked, finite, and of a proper rotation.
    """

    stamp: float
    sequence: int
    T: Array
    valid: NDArray[np.bool_]


class PoseSensor(Device):
    """A source of poses that keeps only its latest sample. `with` connects and disconnects.

    Attributes:
        n_bodies: Number of bodies k.
    """

    n_bodies: int

    @abstractmethod
    def connect(self) -> None:
        """Opens the source; samples arrive from now on."""

    @abstractmethod
    def latest(self) -> PoseSample | None:
        """The newest sample, None before the first; never waits. Raises a `HardwareError` if the source has ended."""

    @abstractmethod
    def wait(self, timeout: float, after: int | None = None) -> PoseSample | None:
        """The first sample newer than frame `after`, or None after `timeout` s."""

    @property
    def names(self) -> tuple[str, ...]:
        """The bodies, from the base to the tip."""
        return tuple(f"sensor_{k + 1}" for k in range(self.n_bodies))

    @property
    def base(self) -> Array | None:
        """The arm's base frame in the source's own world, m, (4, 4); None where the source does not tell."""
        return None

    @abstractmethod
    def disconnect(self) -> None:
        """Closes the source. Safe to call in any state."""


def check_library(library: str, driver: str, extra: str = "hardware") -> None:
    """Raises ConfigError, which says how to install it, where a driver's library is missing."""
    if find_spec(library) is None:
        raise ConfigError(f"{driver} needs {library}: pip install 'apcc-torch[{extra}]'")
