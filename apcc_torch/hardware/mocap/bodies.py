"""A frame of motion capture, as any maker's stream has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class BodyPose:
    """A rigid body of a frame: position (x, y, z) in streamed units, quaternion (x, y, z, w), tracked or not."""

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    tracked: bool


class Frame(Protocol):
    """One frame of motion capture."""

    @property
    def sequence(self) -> int:
        """Frame number."""

    @property
    def bodies(self) -> Mapping[int, BodyPose]:
        """Rigid bodies by their number in the stream."""

    def times(self, tick_rate: int) -> tuple[float, float, bool]:
        """When the frame was measured and sent, s of the server's clock, and by which of its two clocks.

        Args:
            tick_rate: Ticks per second of the server's stamps.
        """
