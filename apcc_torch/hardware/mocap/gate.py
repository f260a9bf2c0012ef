"""Which rigid bodies of a frame to believe: what the source says, what a pose must be, and what a body can do.

This is the device's own gate: it knows no arm. What an arm can do (reach, bend, twist) is judged behind it, by
`estimation.sensor_gate.SensorGate`. A body is judged against its last accepted pose. Once it has jumped, or has
taken another's identity, it is believed again only after some frames in a row that agree with each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from apcc_torch.hardware.mocap.bodies import BodyPose
from apcc_torch.hardware.mocap.settings import MocapSettings

_LONGEST_GAP = 0.1  # s: a limit on speed allows no more way than this, however long a body was out of sight
_PLACE_LIFETIME = 1.0  # s: the age from which a body's place is no evidence for another's having taken it

Vector = tuple[float, float, float]


class Reason(IntEnum):
    """Why a body is not valid in a frame; the first that holds."""

    OK = 0
    MISSING = 1  # the frame does not hold it
    UNTRACKED = 2  # the source says so; it repeats the last pose
    NON_FINITE = 3  # a NaN or an infinite number
    BAD_QUATERNION = 4  # its length is not 1
    FROZEN = 5  # the very same numbers for many frames: no measurement has no noise
    SWAPPED = 6  # it jumped to where another body was
    JUMP = 7  # farther from the last pose than the rate limits allow
    RECOVERING = 8  # consistent again, but not for long enough
    BASE = 9  # the base is not known, or has been moved
    LATE = 10  # the frame was too old when it came


@dataclass(frozen=True)
class _Sight:
    """A pose and its time."""

    position: Vector
    quaternion: tuple[float, float, float, float]
    time: float

    def allows(self, body: BodyPose, time: float, settings: MocapSettings) -> bool:
        """Whether the body can have moved from here to there by then."""
        waited = min(max(time - self.time, 0.0), _LONGEST_GAP)
        if math.dist(self.position, body.position) > settings.position_margin + settings.max_speed * waited:
            return False
        dot = abs(sum(a * b for a, b in zip(self.quaternion, body.quaternion, strict=True)))
        return 2.0 * math.acos(min(dot, 1.0)) <= settings.angle_margin + settings.max_angular_rate * waited


@dataclass
class _Track:
    """What is known of one body."""

    accepted: _Sight | None = None
    candidate: _Sight | None = None  # its last pose since it was doubted
    streak: int | None = None  # consistent frames since then; None where it is not in doubt
    place: Vector | None = None  # where it was last known to be, under its own name or another's
    place_time: float = -math.inf
    raw: BodyPose | None = field(default=None, repr=False)
    same: int = 0  # frames in a row with the same raw pose

    def settle(self, position: Vector, time: float) -> None:
        self.place, self.place_time = position, time


class BodyGate:
    """Judges the bodies of each frame; the order of bodies is fixed."""

    def __init__(self, bodies: int, settings: MocapSettings) -> None:
        self._settings = settings
        self._tracks = [_Track() for _ in range(bodies)]

    def distrust(self) -> None:
        """Puts every body in doubt, as after a restart of the source: names may mean other bodies now."""
        for track in self._tracks:
            track.streak, track.candidate = 0, None

    def judge(self, bodies: Sequence[BodyPose | None], time: float) -> list[Reason]:
        """Judges one frame.

        Args:
            bodies: Each body's pose, positions in m; None where the frame does not hold it.
            time: When the frame was measured, s.
        """
        reasons = [self._evident(track, body) for track, body in zip(self._tracks, bodies, strict=True)]
        places = [track.place if time - track.place_time < _PLACE_LIFETIME else None for track in self._tracks]
        taken: dict[int, Vector] = {}
        for i, (track, body) in enumerate(zip(self._tracks, bodies, strict=True)):
            if body is None or reasons[i] is not Reason.OK:
                track.streak = None if track.streak is None else 0
                continue
            trusted = track.streak is None and (track.accepted is None or self._allows(track.accepted, body, time))
            other = self._identity(i, body.position, places)
            if other is not None:
                taken[other] = body.position
                track.streak, track.candidate = 0, None
                reasons[i] = Reason.SWAPPED
            elif not trusted:
                reasons[i] = self._recover(track, body, time)
            if reasons[i] is Reason.OK:
                track.streak, track.candidate = None, None
                track.accepted = _Sight(body.position, body.quaternion, time)
                track.settle(body.position, time)
        for other, position in taken.items():  # the one whose place was taken is seen there under a wrong name
            if reasons[other] is not Reason.OK:
                self._tracks[other].settle(position, time)
        return reasons

    def _allows(self, sight: _Sight, body: BodyPose, time: float) -> bool:
        return sight.allows(body, time, self._settings)

    def _evident(self, track: _Track, body: BodyPose | None) -> Reason:
        """What the body's own numbers tell."""
        if body is None:
            track.raw = None
            return Reason.MISSING
        if not body.tracked:
            track.raw = None
            return Reason.UNTRACKED
        track.same = track.same + 1 if track.raw == body else 1
        track.raw = body
        if not all(map(math.isfinite, (*body.position, *body.quaternion))):
            return Reason.NON_FINITE
        if abs(math.hypot(*body.quaternion) - 1.0) > self._settings.quaternion_tolerance:
            return Reason.BAD_QUATERNION
        if 0 < self._settings.frozen_frames <= track.same:
            return Reason.FROZEN
        return Reason.OK

    def _identity(self, i: int, position: Vector, places: Sequence[Vector | None]) -> int | None:
        """The other body whose place is nearest, if it is nearer than the body's own and within the swap radius."""
        own = places[i]
        nearest, other = math.inf if own is None else math.dist(own, position), None
        for j, place in enumerate(places):
            if j != i and place is not None and math.dist(place, position) < nearest:
                nearest, other = math.dist(place, position), j
        return other if nearest <= self._settings.swap_radius else None

    def _recover(self, track: _Track, body: BodyPose, time: float) -> Reason:
        """Counts the consistent frames of a body in doubt."""
        consistent = track.candidate is not None and self._allows(track.candidate, body, time)
        track.candidate = _Sight(body.position, body.quaternion, time)
        jumped = not consistent and track.accepted is not None and not self._allows(track.accepted, body, time)
        track.streak = (track.streak or 0) + 1 if consistent else 1
        if track.streak >= self._settings.recovery_frames:
            return Reason.OK
        return Reason.JUMP if jumped else Reason.RECOVERING
