"""A calibration and the settings of a run: whether the two fit, and the settings with what was measured."""

from __future__ import annotations

from apcc_torch.classes import name_of
from apcc_torch.composition.realtime import RealtimeSettings
from apcc_torch.errors import ConfigError
from apcc_torch.hardware.calibration_file import ArmCalibration
from apcc_torch.part import part_of
from apcc_torch.reading import plain


def lasting_settings(settings: RealtimeSettings) -> dict[str, object]:
    """The settings that lengths and poses depend on, by their keys: a calibration holds for these alone."""
    values: dict[str, object] = {"arm.base": settings.arm.base}
    for name in ("actuator", "sensor"):
        device = getattr(settings.hardware, name)
        kind = part_of(device)
        values[f"hardware.{name}.kind"] = name_of(kind)
        values |= {f"hardware.{name}.{key}": plain(getattr(device, key)) for key in kind.lasting}
    return values


def load_calibration(settings: RealtimeSettings) -> ArmCalibration | None:
    """The calibration of `calibration.file`, if one is named.

    Raises:
        ConfigError: It does not fit the settings, or an arm that needs one has none.
        DataError: The file cannot be used.
    """
    file, identity = settings.calibration.file, settings.calibration.id
    if file is None:
        if part_of(settings.hardware.actuator).needs_calibration:
            raise ConfigError("calibration.file must name the arm's calibration: experiment=calibration measures one")
        return None
    calibration = ArmCalibration.load(file)
    if identity is not None and identity != calibration.id:
        raise ConfigError(f"calibration.id is {identity}, {file} holds {calibration.id}")
    now = lasting_settings(settings)
    for key in sorted(now.keys() | calibration.settings.keys()):
        before = calibration.settings.get(key)
        if now.get(key) != before:
            raise ConfigError(f"{key} is {now.get(key)}, and was {before} when {file} was made: calibrate again")
    return calibration


def calibrated(settings: RealtimeSettings, calibration: ArmCalibration) -> RealtimeSettings:
    """The settings with the abscissae and rest lengths that were measured, where `calibration.lengths` asks for them.

    Racks sit where sensors do, and a section ends at each, as on the paper's platform: what does not have as many
    entries stays as it is.

    Raises:
        ConfigError: A sensor is not where `arm.sensors` says, within `calibration.length_tolerance`.
    """
    abscissae, arm = calibration.rest.abscissae.tolist(), settings.arm
    believed = arm.sensor_places().tolist()
    if len(believed) != len(abscissae):
        raise ConfigError(f"arm.sensors must have the {len(abscissae)} entries of the calibration, got {believed}")
    for k, (measured, said) in enumerate(zip(abscissae, believed, strict=True)):
        if abs(measured - said) > settings.calibration.length_tolerance:
            raise ConfigError(
                f"arm.sensors[{k}] is {said:g} m, and the calibration has {measured:.4f} m: mend one of them, "
                "or widen calibration.length_tolerance"
            )
    if not settings.calibration.lengths or arm.chambers is not None:
        return settings  # an arm with chambers has its lengths at their pressure of rest, and hangs without
    racks = len(abscissae) if arm.racks is None else len(arm.racks)
    changes: dict[str, object] = {"sensors": abscissae, "racks": abscissae if racks == len(abscissae) else arm.racks}
    if arm.n_sections == len(abscissae):
        changes["lengths"] = calibration.rest.rest_lengths.tolist()
    return settings.changed(arm=arm.changed(**changes))
