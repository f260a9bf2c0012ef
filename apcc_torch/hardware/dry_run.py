"""Motors that are only looked at: a dry run reads them, and says what it would send."""

from __future__ import annotations

from collections.abc import Mapping

from apcc_torch.hardware.interfaces import Array, TendonActuator, TendonReading


class DryRunActuator(TendonActuator):
    """Another actuator without its torque: `arm`, `send`, `hold` and `torque_off` reach no motor.

    Args:
        actuator: Connected, read and disconnected as ever.
    """

    def __init__(self, actuator: TendonActuator) -> None:
        self.actuator = actuator
        self.n_tendons = actuator.n_tendons
        self.pressures = actuator.sets_pressure

    @property
    def sets_pressure(self) -> bool:  # type: ignore[override]
        """As the device."""
        return self.pressures

    def connect(self) -> None:
        """Opens the device; torque stays off."""
        self.actuator.connect()

    def calibrate(self) -> dict[str, object]:
        """As the device."""
        return self.actuator.calibrate()

    def restore(self, zero: Mapping[str, object]) -> None:
        """As the device."""
        self.actuator.restore(zero)

    def arm(self) -> None:
        """Nothing: the motors stay without torque."""

    def read(self) -> TendonReading:
        """As the device."""
        return self.actuator.read()

    def rounded(self, y: Array, low: Array, high: Array) -> Array:
        """As the device."""
        return self.actuator.rounded(y, low, high)

    def send(self, y: Array) -> Array:
        """Returns y (n_a,), m, as if it had been sent."""
        return y

    def hold(self) -> None:
        """Nothing: there is no torque to hold with."""

    def torque_off(self) -> None:
        """Nothing: there was never torque."""

    def disconnect(self) -> None:
        """Closes the device."""
        self.actuator.disconnect()
