"""The calibration of an arm: what was found of its motors and bodies as it hung at rest, in one versioned file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from apcc_torch.errors import DataError, SafetyError
from apcc_torch.estimation.rest_calibration import Calibration
from apcc_torch.files import write_json
from apcc_torch.hardware.interfaces import Array
from apcc_torch.lie.rotations import chordal_mean, rotation_angle

KIND, VERSION = "apcc_torch.arm_calibration", 1


@dataclass(frozen=True)
class ArmCalibration:
    """One calibration. Two with the same content have the same `id`.

    Attributes:
        made_at: Date and time, ISO 8601, UTC.
        settings: What it holds for: the devices' settings that lengths and poses depend on.
        versions: Of the programs that made it.
        actuator: What `TendonActuator.calibrate` found.
        base: The arm's base frame in the source's own world, m, (4, 4) row by row; None where the source does not tell.
        rest: Names, mounts and abscissae of the bodies.
        signs: (n_a,) m by which the tip went the right way as each tendon was pulled in; None if that was not tried.
    """

    made_at: str
    settings: dict[str, object]
    versions: dict[str, str]
    actuator: dict[str, object]
    base: list[list[float]] | None
    rest: Calibration
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
        return write_json(path, json.loads(self.text()))

    @staticmethod
    def load(path: Path | str) -> ArmCalibration:
        """Reads a file that `save` wrote.

        Raises:
            DataError: It is missing, damaged, changed by hand, or of another kind or version.
        """
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise DataError(f"the calibration {path} cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise DataError(f"the calibration {path} is not a JSON file: {error}") from error
        if not isinstance(content, dict) or content.get("kind") != KIND:
            raise DataError(f"{path} is not the calibration of an arm")
        if content.get("version") != VERSION:
            raise DataError(f"{path} has version {content.get('version')!r}, this program reads {VERSION}")
        try:
            values = {field.name: content[field.name] for field in fields(ArmCalibration)}
        except KeyError as error:
            raise DataError(f"the calibration {path} lacks the entry {error}") from error
        found = ArmCalibration(**values | {"rest": Calibration.of(values["rest"], path)})
        if content.get("id") != found.id:
            raise DataError(f"the calibration {path} was changed: its content does not fit its id {content.get('id')}")
        return found


def fingerprint(content: Mapping[str, object]) -> str:
    """Twelve characters that stand for plain values."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]


def rest_calibration(names: Sequence[str], T: Array, base_rotation: Tensor, scatter: float) -> Calibration:
    """Mounts and abscissae from the arm hanging at rest; it counts as straight, along the base's axis.

    Args:
        names: Of the k bodies, from the base to the tip.
        T: (N, k, 4, 4) their poses in the arm's base frame, m.
        base_rotation: (3, 3) the model's base in that frame.
        scatter: Largest distance of a frame from the rest pose, m.

    Raises:
        SafetyError: A body moved, or they are not in order along the arm.
    """
    poses = torch.tensor(T)
    P = torch.tensor(np.median(T[..., :3, 3], axis=0))
    R = torch.stack([chordal_mean(poses[:, k, :3, :3]) for k in range(len(names))])
    far = torch.linalg.vector_norm(poses[..., :3, 3] - P, dim=-1).amax(0)
    if float(far.max()) > scatter:
        name, mm = names[int(far.argmax())], 1e3 * float(far.max())
        raise SafetyError(f"{name} moved by {mm:.1f} mm while the arm was to hang at rest")
    axes = base_rotation.to(P)
    abscissae = P @ axes[:, 2]
    if not bool((torch.diff(abscissae, prepend=abscissae.new_zeros(1)) > 0).all()):
        raise SafetyError(f"the bodies {', '.join(names)} hang at {abscissae.tolist()} m, not in order along the arm")
    offset = (R.mT @ (abscissae.unsqueeze(-1) * axes[:, 2] - P).unsqueeze(-1)).squeeze(-1)
    wide = max(float(rotation_angle(R[k], poses[:, k, :3, :3]).max()) for k in range(len(names)))
    base = torch.zeros(3, dtype=P.dtype)
    return Calibration(tuple(names), base, axes, R.mT @ axes, offset, abscissae, len(T), float(far.max()), wide)
