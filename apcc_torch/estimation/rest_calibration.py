"""Where an arm's base is and how each sensor sits on it: constants that turn measured poses into the model's."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from apcc_torch.errors import DataError
from apcc_torch.files import json_in, read_text, write_atomically
from apcc_torch.shapes import check_finite, check_tensor

VERSION = 1
_KIND = "apcc_torch.calibration"


@dataclass(frozen=True)
class RestCalibration:
    """Constants that turn recorded poses of k sensors into poses of the model's frames in the base frame.

    Attributes:
        names: The sensors' names, k of them, from the base to the tip.
        base_position: The base frame's origin in the recording frame, m, shape (3,).
        base_rotation: The base frame's axes in the recording frame as columns, shape (3, 3).
        mount_rotation: The model frame's axes in each sensor's frame as columns, shape (k, 3, 3).
        mount_offset: The model frame's origin in each sensor's frame, m, shape (k, 3).
        abscissae: Rest distance from the base along the arm of each sensor, m, shape (k,).
        rest_frames: Number of frames the calibration was computed from.
        rest_scatter_m: Largest distance of a rest frame's position from the rest position, m.
        rest_scatter_rad: Largest angle of a rest frame's rotation from the rest rotation, rad.

    Example:
        >>> one, place = torch.eye(3).double(), torch.tensor([[0.0, 0.0, 0.4]]).double()
        >>> calibration = RestCalibration.at_rest(("tip",), 0.0 * place[0], one, place, one.unsqueeze(0))
        >>> calibration.abscissae
        tensor([0.4000], dtype=torch.float64)
    """

    names: tuple[str, ...]
    base_position: Tensor
    base_rotation: Tensor
    mount_rotation: Tensor
    mount_offset: Tensor
    abscissae: Tensor
    rest_frames: int = 0
    rest_scatter_m: float = 0.0
    rest_scatter_rad: float = 0.0

    @staticmethod
    def at_rest(
        names: Sequence[str], base_position: Tensor, base_rotation: Tensor, position: Tensor, rotation: Tensor
    ) -> RestCalibration:
        """The calibration from sensors at rest, where the arm counts as straight, along the base's z axis.

        Args:
            names: Of the sensors, k of them.
            base_position: (3,) the base in the recording frame, m.
            base_rotation: (3, 3) its axes there, as columns.
            position: (k, 3) of the sensors at rest, m.
            rotation: (k, 3, 3) their axes at rest, as columns.
        """
        z = base_rotation[:, 2]
        abscissae = position @ z - base_position @ z
        beside = base_position + abscissae.unsqueeze(-1) * z - position
        offset = (rotation.mT @ beside.unsqueeze(-1)).squeeze(-1)
        return RestCalibration(
            tuple(names), base_position, base_rotation, rotation.mT @ base_rotation, offset, abscissae
        )

    @property
    def rest_lengths(self) -> Tensor:
        """Rest lengths from the base to the first sensor, and from each sensor to the next, m, shape (k,)."""
        return torch.diff(self.abscissae, prepend=self.abscissae.new_zeros(1))

    def poses(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Poses of the model's frames at the sensors' abscissae.

        Args:
            position: Sensor positions in the recording frame, m, shape (..., k, 3).
            rotation: Sensor axes in the recording frame as columns, shape (..., k, 3, 3).

        Returns:
            Poses in the base frame, shape (..., k, 4, 4).
        """
        k = len(self.names)
        check_tensor("position", position, (k, 3))
        check_tensor("rotation", rotation, (k, 3, 3))
        to_base = self.base_rotation.mT.to(rotation)
        R = to_base @ rotation @ self.mount_rotation.to(rotation)
        point = position + (rotation @ self.mount_offset.to(rotation).unsqueeze(-1)).squeeze(-1)
        t = to_base @ (point - self.base_position.to(position)).unsqueeze(-1)
        bottom = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*R.shape[:-2], 1, 4)
        return torch.cat((torch.cat((R, t), dim=-1), bottom), dim=-2)

    def points(self, position: Tensor) -> Tensor:
        """Points of the recording frame (..., 3), such as targets, in the base frame, m."""
        return (check_tensor("position", position, (3,)) - self.base_position.to(position)) @ self.base_rotation.to(
            position
        )

    def content(self) -> dict[str, object]:
        """Plain values for a file, every number exactly; `of` takes them."""
        content: dict[str, object] = {"kind": _KIND, "version": VERSION}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            content[field.name] = value.tolist() if isinstance(value, Tensor) else value
        return content

    def save(self, path: str | Path) -> None:
        """Writes the calibration as JSON, atomically, every number exactly."""
        write_atomically(path, json.dumps(self.content(), indent=1) + "\n")

    @staticmethod
    def load(path: str | Path) -> RestCalibration:
        """Reads a calibration written by `save`, in float64.

        Raises:
            DataError: The file is missing, damaged, or of another kind or version.
        """
        return RestCalibration.of(json_in(read_text(path, name=str(path)), str(path)), path)

    @staticmethod
    def of(content: object, path: str | Path) -> RestCalibration:
        """The calibration that `content` gave, in float64.

        Args:
            content: Plain values.
            path: The file they came from, for messages.

        Raises:
            DataError: They are damaged, or of another kind or version.
        """
        if not isinstance(content, dict) or content.get("kind") != _KIND:
            raise DataError(f"{path}: is not a calibration")
        if content.get("version") != VERSION:
            raise DataError(f"{path}: has version {content.get('version')!r}, this program reads {VERSION}")
        try:
            names = tuple(str(name) for name in content["names"])
            k = len(names)
            shapes = {
                "base_position": (3,),
                "base_rotation": (3, 3),
                "mount_rotation": (k, 3, 3),
                "mount_offset": (k, 3),
                "abscissae": (k,),
            }
            tensors = {
                key: torch.tensor(content[key], dtype=torch.float64).reshape(shape) for key, shape in shapes.items()
            }
            return RestCalibration(
                names,
                **{key: check_finite(key, value) for key, value in tensors.items()},
                rest_frames=int(content["rest_frames"]),
                rest_scatter_m=float(content["rest_scatter_m"]),
                rest_scatter_rad=float(content["rest_scatter_rad"]),
            )
        except KeyError as error:
            raise DataError(f"{path}: lacks the entry {error}") from error
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise DataError(f"{path}: holds an entry of the wrong form ({error})") from error
