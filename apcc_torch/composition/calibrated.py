"""A calibration and the settings of a run: whether the two fit, and the settings with what was measured."""

from __future__ import annotations

from dataclasses import replace

from apcc_torch.composition.realtime import RealtimeConfig
from apcc_torch.errors import ConfigError
from apcc_torch.hardware.calibration_file import ArmCalibration

DYNAMIXEL_KEYS = ("ids", "spool_radii", "signs")
OPTITRACK_KEYS = ("base", "bodies", "up", "scale", "base_offset", "base_quaternion")


def device_settings(config: RealtimeConfig) -> dict[str, object]:
    """The settings that lengths and poses depend on, by their keys: a calibration holds for these alone."""
    hardware = config.hardware
    found: dict[str, object] = {"hardware.kind": hardware.kind, "robot.base": config.robot.base}
    if hardware.dynamixel is not None:
        found |= {f"hardware.dynamixel.{key}": getattr(hardware.dynamixel, key) for key in DYNAMIXEL_KEYS}
    if hardware.optitrack is not None:
        found |= {f"hardware.optitrack.{key}": getattr(hardware.optitrack, key) for key in OPTITRACK_KEYS}
    return found


def body_names(config: RealtimeConfig) -> tuple[str, ...]:
    """The tracked bodies, from the base to the tip."""
    if config.hardware.optitrack is not None:
        return tuple(config.hardware.optitrack.bodies)
    return tuple(f"sensor_{k + 1}" for k in range(len(config.robot.sensors)))


def load_calibration(config: RealtimeConfig) -> ArmCalibration | None:
    """The calibration of `calibration.file`, if one is given.

    Raises:
        ConfigError: It does not fit the settings, or an arm that needs one has none.
        DataError: The file cannot be used.
    """
    wanted = config.calibration
    if wanted.file is None:
        if config.hardware.dynamixel is not None:
            raise ConfigError("calibration.file must name the arm's calibration: experiment=calibration measures one")
        return None
    calibration = ArmCalibration.load(wanted.file)
    if wanted.id is not None and wanted.id != calibration.id:
        raise ConfigError(f"calibration.id is {wanted.id}, {wanted.file} holds {calibration.id}")
    now = device_settings(config)
    for key in sorted(now.keys() | calibration.settings.keys()):
        if now.get(key) != calibration.settings.get(key):
            raise ConfigError(
                f"{key} is {now.get(key)}, and was {calibration.settings.get(key)} when {wanted.file} was made: "
                "calibrate again"
            )
    return calibration


def calibrated(config: RealtimeConfig, calibration: ArmCalibration) -> RealtimeConfig:
    """The settings with the abscissae and rest lengths that were measured, where `calibration.lengths` asks for them.

    Racks sit where sensors do, and a section ends at each, as on the paper's platform: what does not have as many
    entries stays as it is.

    Raises:
        ConfigError: A sensor is not where `robot.sensors` says, within `calibration.length_tolerance`.
    """
    abscissae = calibration.rest.abscissae.tolist()
    robot = config.robot
    if len(robot.sensors) != len(abscissae):
        raise ConfigError(
            f"robot.sensors must have the {len(abscissae)} entries of the calibration, got {robot.sensors}"
        )
    for k, (measured, said) in enumerate(zip(abscissae, robot.sensors, strict=True)):
        if abs(measured - said) > config.calibration.length_tolerance:
            raise ConfigError(
                f"robot.sensors[{k}] is {said:g} m, and the calibration has {measured:.4f} m: mend one of them, "
                "or widen calibration.length_tolerance"
            )
    if not config.calibration.lengths:
        return config
    racks = abscissae if len(robot.racks) == len(abscissae) else robot.racks
    lengths = (
        calibration.rest.rest_lengths.tolist() if len(robot.rest_lengths) == len(abscissae) else robot.rest_lengths
    )
    return replace(config, robot=replace(robot, sensors=abscissae, racks=racks, rest_lengths=lengths))
