"""The calibration of an arm: what was measured of its motors and bodies as it hung at rest, in one versioned file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from apcc_torch.errors import DataError
from apcc_torch.estimation.rest_calibration import RestCalibration
from apcc_torch.files import json_in, read_text, write_atomically

KIND, VERSION = "apcc_torch.arm_calibration", 1


@dataclass(frozen=True)
class ArmCalibration:
    """One calibration. Two with the same content have the same `id`.

    Attributes:
        made_at: Date and time, ISO 8601, UTC.
        settings: What it holds for: the devices' settings that lengths and poses depend on.
        versions: Of the programs that made it.
        actuator: What `TendonActuator.calibrate` returned.
        base: The arm's base frame in the source's own world, m, (4, 4) row by row; None where the source does not tell.
        rest: Names, mounts and abscissae of the bodies.
        signs: (n_a,) m by which the tip went the right way as each tendon was pulled in; None if that was not tried.
    """

    made_at: str
    settings: dict[str, object]
    versions: dict[str, str]
    actuator: dict[str, object]
    base: list[list[float]] | None
    rest: RestCalibration
    signs: list[float] | None = None

    def content(self) -> dict[str, object]:
        """Plain values for a file."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return values | {"rest": self.rest.content(), "rest_lengths": self.rest.rest_lengths.tolist()}

    @property
    def id(self) -> str:
        """Twelve characters that stand for the whole content."""
        return fingerprint(self.content())

    def text(self) -> str:
        """The file's text."""
        head = {"kind": KIND, "version": VERSION, "id": self.id, "settings_fingerprint": fingerprint(self.settings)}
        return json.dumps(head | self.content(), indent=2) + "\n"

    def save(self, path: Path | str) -> Path:
        """Writes the file whole, or not at all."""
        return write_atomically(path, self.text())

    @staticmethod
    def load(path: Path | str) -> ArmCalibration:
        """Reads a file that `save` wrote.

        Raises:
            DataError: It is missing, damaged, changed by hand, or of another kind or version.
        """
        content = json_in(read_text(path, name=f"the calibration {path}"), f"the calibration {path}")
        if not isinstance(content, dict) or content.get("kind") != KIND:
            raise DataError(f"{path} is not the calibration of an arm")
        if content.get("version") != VERSION:
            raise DataError(f"{path} has version {content.get('version')!r}, this program reads {VERSION}")
        try:
            values = {field.name: content[field.name] for field in fields(ArmCalibration)}
        except KeyError as error:
            raise DataError(f"the calibration {path} lacks the entry {error}") from error
        calibration = ArmCalibration(**values | {"rest": RestCalibration.of(values["rest"], path)})
        if content.get("id") != calibration.id:
            raise DataError(f"the calibration {path} was changed: its content does not fit its id {content.get('id')}")
        return calibration


def fingerprint(content: Mapping[str, object]) -> str:
    """Twelve characters that stand for plain values."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]
