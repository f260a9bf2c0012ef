"""What a file of a recording holds, before its poses are turned into metres and the frame that is meant."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from apcc_torch.recordings.raw_poses import RawPoses


@dataclass(frozen=True)
class FramesRead:
    """T frames of k bodies.

    names: Of the bodies. times: (T,) s. raw: Their poses. inputs, actuators: (T, m) what was sent to the actuators and
    what they measured. target: (T, 3). groups: (T,) int64 number of the movement. source: The file.
    """

    names: tuple[str, ...]
    times: Tensor
    raw: RawPoses
    inputs: Tensor | None
    actuators: Tensor | None
    target: Tensor | None
    groups: Tensor | None
    source: str

    def first(self, count: int) -> FramesRead:
        """The first so many frames."""
        raw = replace(
            self.raw,
            position=self.raw.position[:count],
            quaternion=self.raw.quaternion[:count],
            tracked=self.raw.tracked[:count],
        )

        def cut(value: Tensor | None) -> Tensor | None:
            return None if value is None else value[:count]

        return replace(
            self,
            times=self.times[:count],
            raw=raw,
            inputs=cut(self.inputs),
            actuators=cut(self.actuators),
            target=cut(self.target),
            groups=cut(self.groups),
        )
