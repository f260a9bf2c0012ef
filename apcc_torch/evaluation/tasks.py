"""What is asked of a method: which bodies it is shown, whether it is told the motors, and what it may follow."""

from __future__ import annotations

from typing import NamedTuple


class Task(NamedTuple):
    """One question about a recording: where the bodies are that are not shown.

    shown: Bodies that are shown, from 0. motors: Whether what drives the arm is told.
    orientations: Whether the shown bodies' orientations are told too.
    online: Whether the part of the session before the scored one may be seen whole, and followed.
    ahead: Whether all bodies are shown up to the sample before.
    """

    shown: tuple[int, ...]
    motors: bool
    orientations: bool = False
    online: bool = False
    ahead: bool = False

    @property
    def name(self) -> str:
        """Such as "disks 1, 3 and motors"."""
        parts = []
        if self.shown:
            parts.append(f"bod{'y' if len(self.shown) == 1 else 'ies'} {', '.join(str(b + 1) for b in self.shown)}")
        if self.orientations:
            parts.append("orientations")
        if self.motors:
            parts.append("motors")
        told = " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)
        return told + ", load followed" * self.online + ", one step ahead" * self.ahead

    def hidden(self, k: int) -> tuple[int, ...]:
        """The bodies of k that are asked for, from 0."""
        return tuple(b for b in range(k) if b not in self.shown)


def tasks_of(k: int, orientations: bool) -> list[Task]:
    """What is asked about an arm with k bodies.

    Motors alone, with and without following what the session showed before, and one step ahead; then each body from all
    others, and all from the last one, from sensors alone and with the motors.

    Args:
        k: Number of bodies.
        orientations: Whether there are some.
    """
    asked = [Task((), True), Task((), True, online=True), Task((), True, ahead=True)]
    sets = [tuple(b for b in range(k) if b != hidden) for hidden in range(k)] if k > 1 else []
    sets += [(k - 1,)] if k > 2 else []
    for turned in (False, True) if orientations else (False,):
        asked += [Task(shown, motors, turned) for shown in sets for motors in (False, True)]
    return asked
