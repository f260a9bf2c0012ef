"""Instants of an arm as messages of Foxglove's own schemas, in m; see `frames` for what they stand in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import cycle
from typing import Any

import numpy as np
import torch

from apcc_torch.lie.rotations import rotation_quaternion
from apcc_torch.messages.foxglove_library import foxglove
from apcc_torch.messages.frames import WORLD
from apcc_torch.report import style
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.moment import Array, Moment
from apcc_torch.viewing.tube import tube

SECOND = 10**9
TENDON, SENSOR, TARGET = (style.faded(style.MUTED, 0.8), style.faded(style.SENSOR, 1.0), style.faded(style.TARGET, 1.0))
OPACITY = 0.5
"""Of the arm, so that the model in it is seen."""


class SceneMessages:
    """Makes the messages.

    Raises:
        ConfigError: foxglove-sdk is not installed.
    """

    def __init__(self, size: DrawnSize) -> None:
        self.m: Any = foxglove().messages
        self.size = size

    def transforms(self, frames: Iterable[tuple[str, Array]], stamp: int) -> Any:
        """FrameTransforms of frames in `world`: name and pose (4, 4), m; those that are not finite are left out.

        Args:
            frames: Each of them.
            stamp: ns since 1970.
        """
        seen = [(name, T) for name, T in frames if np.isfinite(T).all()]
        turns = self._turns([T for _, T in seen])
        return self.m.FrameTransforms(
            transforms=[
                self.m.FrameTransform(
                    timestamp=self._time(stamp),
                    parent_frame_id=WORLD,
                    child_frame_id=name,
                    translation=self._vector(T[:3, 3]),
                    rotation=turn,
                )
                for (name, T), turn in zip(seen, turns, strict=True)
            ]
        )

    def poses(self, T: Array, stamp: int) -> Any:
        """PosesInFrame of poses (k, 4, 4), m, without those that are not finite."""
        poses = self._poses([each for each in T if np.isfinite(each).all()])
        return self.m.PosesInFrame(timestamp=self._time(stamp), frame_id=WORLD, poses=poses)

    def pose(self, T: Array, stamp: int) -> Any:
        """PoseInFrame of a pose (4, 4), m."""
        return self.m.PoseInFrame(timestamp=self._time(stamp), frame_id=WORLD, pose=self._poses([T])[0])

    def remark(self, name: str, message: str, failed: bool, stamp: int) -> Any:
        """Log: something that happened."""
        level = self.m.LogLevel.Error if failed else self.m.LogLevel.Info
        return self.m.Log(timestamp=self._time(stamp), level=level, name=name, message=message)

    def scene(self, moment: Moment, stamp: int) -> Any:
        """SceneUpdate with all that a moment has: each part is an entity that the next update replaces."""
        m, radius = self.m, self.size.radius
        parts: dict[str, dict[str, Any]] = {
            f"section_{i + 1}": {"triangles": [self._tube(points, radius, color, OPACITY)]}
            for i, (points, color) in enumerate(zip(moment.sections, cycle(style.SERIES), strict=False))
        }
        parts["backbone"] = {"triangles": [self._tube(line, 0.25 * radius, style.INK, 1.0) for line in moment.sections]}
        if moment.model is not None:
            parts["model"] = {"triangles": [self._tube(moment.model, 0.36 * radius, style.MUTED, 1.0)]}
        if moment.tendons is not None:
            parts["tendons"] = {"lines": self._tendons(moment.tendons)}
        if moment.sensors is not None:
            places = moment.sensors if moment.sensors.ndim == 2 else moment.sensors[:, :3, 3]
            seen = [place for place in places if np.isfinite(place).all()]
            parts["sensors"] = {"spheres": [self._ball(place, 1.25 * radius, SENSOR) for place in seen]}
        if moment.target is not None and moment.target.ndim == 1:
            parts["target"] = {"spheres": [self._ball(moment.target, 0.8 * radius, TARGET)]}
        return m.SceneUpdate(
            entities=[
                m.SceneEntity(timestamp=self._time(stamp), frame_id=WORLD, id=name, **drawn)
                for name, drawn in parts.items()
            ]
        )

    def _time(self, stamp: int) -> Any:
        return self.m.Timestamp(*divmod(stamp, SECOND))

    def _vector(self, place: Array) -> Any:
        x, y, z = place.tolist()
        return self.m.Vector3(x=x, y=y, z=z)

    def _turns(self, T: Sequence[Array]) -> list[Any]:
        """Quaternions of poses (4, 4)."""
        rotations = torch.tensor(np.array([each[:3, :3] for each in T])).reshape(-1, 3, 3)
        quaternions = rotation_quaternion(rotations.double()).tolist()
        return [self.m.Quaternion(x=x, y=y, z=z, w=w) for x, y, z, w in quaternions]

    def _poses(self, T: Sequence[Array]) -> list[Any]:
        pairs = zip(T, self._turns(T), strict=True)
        return [self.m.Pose(position=self._vector(each[:3, 3]), orientation=turn) for each, turn in pairs]

    def _color(self, rgb: tuple[float, float, float], opacity: float = 1.0) -> Any:
        r, g, b = rgb
        return self.m.Color(r=r, g=g, b=b, a=opacity)

    def _points(self, points: Array) -> list[Any]:
        point = self.m.Point3
        return [point(x=x, y=y, z=z) for x, y, z in points.astype(float).tolist()]

    def _tube(self, points: Array, radius: float, color: str, opacity: float) -> Any:
        vertices, faces = tube(points, radius)
        return self.m.TriangleListPrimitive(
            points=self._points(vertices),
            indices=faces.flatten().tolist(),
            color=self._color(style.faded(color, 1.0), opacity),
        )

    def _tendons(self, paths: Array) -> list[Any]:
        """A line for each tendon, of the points at which it runs."""
        runs = [path[np.isfinite(path).all(-1)] for path in paths]
        kind = self.m.LinePrimitiveLineType.LineStrip
        look = {"type": kind, "thickness": 0.2 * self.size.radius, "color": self._color(TENDON)}
        return [self.m.LinePrimitive(points=self._points(path), **look) for path in runs if len(path)]

    def _ball(self, place: Array, radius: float, color: tuple[float, float, float]) -> Any:
        m, across = self.m, 2.0 * radius
        return m.SpherePrimitive(
            pose=m.Pose(position=self._vector(place), orientation=m.Quaternion(w=1.0)),
            size=m.Vector3(x=across, y=across, z=across),
            color=self._color(color),
        )
