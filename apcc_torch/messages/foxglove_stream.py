"""The topics of a run for Foxglove."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from apcc_torch.messages.foxglove_scene import SceneMessages
from apcc_torch.messages.frames import BASE, TIP, placed, sensor_frame, turned
from apcc_torch.messages.run_layout import Numbers, run_layout
from apcc_torch.messages.topic import Sink, Topic
from apcc_torch.viewing.drawn_size import DrawnSize
from apcc_torch.viewing.moment import Array, Moment
from apcc_torch.viewing.outline import Outline


class Streamed(NamedTuple):
    """What a stream needs to know of an arm.

    size: How large it is drawn. base: (3, 3) its base's axes in the world. n: Coordinates of the drawn configuration.
    n_b: Sections of the controller's model. n_a: Tendons.
    """

    size: DrawnSize
    base: Array
    n: int
    n_b: int
    n_a: int

    @classmethod
    def of(cls, size: DrawnSize, arm: Outline, model: Outline | None = None) -> Self:
        """Of an arm that is drawn.

        Args:
            size: Of the arm.
            arm: Its outline.
            model: That of the controller's model; None where it is the same.
        """
        backbone = arm.backbone
        sections = (arm if model is None else model).backbone.n_sections
        n_a = 0 if arm.routing is None else arm.routing.n_tendons
        return cls(size, backbone.base_rotation.numpy(), backbone.n, sections, n_a)


class FoxgloveStream:
    """Writes a run's instants as messages.

    `/tf` has the frames, `/sensors`, `/tip` and `/target` poses, `/arm` the scene, `/remarks` what happened, all of
    Foxglove's own schemas, and `/run` the numbers. Stamps are ns since 1970.

    Attributes:
        topics: All of them.

    Raises:
        ConfigError: foxglove-sdk is not installed.
    """

    def __init__(self, sink: Sink, streamed: Streamed) -> None:
        self.sink = sink
        self.make = SceneMessages(streamed.size)
        self.layout = run_layout(streamed.n, streamed.n_b, streamed.n_a)
        self.base = turned(streamed.base)
        kinds = self.make.m
        self.transforms = Topic.well_known("/tf", kinds.FrameTransforms)
        self.sensors = Topic.well_known("/sensors", kinds.PosesInFrame)
        self.tip = Topic.well_known("/tip", kinds.PoseInFrame)
        self.target = Topic.well_known("/target", kinds.PoseInFrame)
        self.scenes = Topic.well_known("/arm", kinds.SceneUpdate)
        self.remarks = Topic.well_known("/remarks", kinds.Log)
        self.run = Topic.numbers(self.layout)
        poses = (self.sensors, self.tip, self.target)
        self.topics = (self.transforms, *poses, self.scenes, self.remarks, self.run)

    def measured(self, T: Array, stamp: int, logged: int | None = None) -> None:
        """Poses (k, 4, 4) that the sensors measured, m, NaN where one did not.

        Args:
            T: The poses.
            stamp: Of the measurement.
            logged: When it was known; None for `stamp`.
        """
        frames = [(BASE, self.base), *((sensor_frame(k), each) for k, each in enumerate(T))]
        at = stamp if logged is None else logged
        self.sink.add(self.transforms, self.make.transforms(frames, stamp).encode(), at, stamp)
        self.sink.add(self.sensors, self.make.poses(T, stamp).encode(), at, stamp)

    def instant(self, tip: Array, numbers: Numbers, stamp: int) -> None:
        """Where the arm's tip (4, 4) is, its target, and the numbers."""
        frames = [(BASE, self.base), (TIP, tip)]
        self.sink.add(self.transforms, self.make.transforms(frames, stamp).encode(), stamp, stamp)
        if np.isfinite(tip).all():
            self.sink.add(self.tip, self.make.pose(tip, stamp).encode(), stamp, stamp)
        if np.isfinite(numbers.target).all():
            self.sink.add(self.target, self.make.pose(placed(numbers.target), stamp).encode(), stamp, stamp)
        self.sink.add(self.run, self.layout.pack(*numbers), stamp, stamp)

    def scene(self, moment: Moment, stamp: int) -> None:
        """The arm as it is drawn."""
        self.sink.add(self.scenes, self.make.scene(moment, stamp).encode(), stamp, stamp)

    def remark(self, name: str, message: str, failed: bool, stamp: int) -> None:
        """Something that happened."""
        self.sink.add(self.remarks, self.make.remark(name, message, failed, stamp).encode(), stamp, stamp)
