"""What a run confirms of its calibration before torque: the motors' zero, the base, and where the bodies hang."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from apcc_torch.errors import DataError, SafetyError
from apcc_torch.hardware.arming import complete_frame
from apcc_torch.hardware.calibration_file import ArmCalibration
from apcc_torch.hardware.interfaces import PoseSensor, TendonActuator
from apcc_torch.hardware.mocap.frames import pose_distance
from apcc_torch.hardware.setup import Setup
from apcc_torch.settings import OURS, Settings, setting


@dataclass(frozen=True, kw_only=True)
class ConfirmationSettings(Settings):
    """How near to its calibration an arm has to be."""

    base_tolerance: float = setting(5e-3, "m", OURS, "by which the base may have moved since", above=0)
    base_angle_tolerance: float = setting(0.03, "rad", OURS, "by which the base may have turned since", above=0)
    rest_tolerance: float | None = setting(
        0.02, "m", OURS, "by which a body may hang beside its place before torque; null: not checked", above=0
    )


def calibration_checks(
    calibration: ArmCalibration, setup: Setup, settings: ConfirmationSettings
) -> list[Callable[[], None]]:
    """The checks in order, for `Setup.checks`; each raises SafetyError with one sentence, or another HardwareError."""

    def zero() -> None:
        restore_zero(calibration, setup.actuator)

    def base() -> None:
        check_base(calibration, setup.sensor, settings)

    def rest() -> None:
        check_rest(calibration, setup, settings)

    return [zero, base] if settings.rest_tolerance is None else [zero, base, rest]


def restore_zero(calibration: ArmCalibration, actuator: TendonActuator) -> None:
    """Gives the motors their zero back.

    Raises:
        SafetyError: The calibration is of other motors.
        HardwareError: A motor has lost its zero since.
    """
    try:
        actuator.restore(calibration.actuator)
    except DataError as error:
        raise SafetyError(f"calibration {calibration.id} does not fit: {error}") from error


def check_base(calibration: ArmCalibration, sensor: PoseSensor, settings: ConfirmationSettings) -> None:
    """Raises SafetyError if the base is not where it was."""
    if calibration.base is None or sensor.base is None:
        return
    moved, turned = pose_distance(sensor.base, np.array(calibration.base))
    if moved > settings.base_tolerance or turned > settings.base_angle_tolerance:
        raise SafetyError(
            f"the base has moved by {1e3 * moved:.1f} mm and {turned:.3f} rad since calibration {calibration.id}: "
            "calibrate again"
        )


def check_rest(calibration: ArmCalibration, setup: Setup, settings: ConfirmationSettings) -> None:
    """Raises SafetyError if a body does not hang where it hung."""
    frame = complete_frame(setup)
    rest = calibration.rest
    place = (rest.abscissae.unsqueeze(-1) * rest.base_rotation[:, 2]).numpy()
    beside = np.linalg.norm(frame.T[:, :3, 3] - place, axis=-1)
    if settings.rest_tolerance is not None and beside.max() > settings.rest_tolerance:
        name = rest.names[int(beside.argmax())]
        raise SafetyError(
            f"{name} hangs {1e3 * beside.max():.1f} mm beside its place in calibration {calibration.id}: let the arm "
            "hang at rest, or calibrate again"
        )
