"""What a run tells those who watch it: every tick, every event, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass

from apcc_torch.hardware.control import Decision, Start
from apcc_torch.hardware.interfaces import Array, TendonReading
from apcc_torch.hardware.sensing import GatedFrame
from apcc_torch.hardware.states import State
from apcc_torch.hardware.stops import Ending, StopReason


@dataclass(slots=True)
class Tick:
    """One turn of the loop, filled in as it goes.

    index: Number on the grid of deadlines. now: s, when the turn began. time: s since the start.
    deadline: s. lateness: s. reading: Of the tendons; None if it failed. frame: A new frame, if there was one.
    decision: The controller's, if it stepped. requested, sent: (n_a,) m, the last lengths wanted, and really sent.
    fresh: Whether `sent` was sent in this turn. read, sense, control, send: s, what each stage took.
    latency: s from the frame's stamp to the end of sending. overruns, failed: So far, missed deadlines and failed
    exchanges.
    """

    index: int
    now: float
    time: float
    deadline: float
    lateness: float
    state: State
    requested: Array
    sent: Array
    fresh: bool = False
    reading: TendonReading | None = None
    frame: GatedFrame | None = None
    decision: Decision | None = None
    read: float = 0.0
    sense: float = 0.0
    control: float = 0.0
    send: float = 0.0
    latency: float | None = None
    overruns: int = 0
    failed: int = 0


@dataclass(frozen=True)
class Event:
    """Something that happens once: a change of state, a failure, a remark. time: s, of the run's clock."""

    time: float
    kind: str
    state: State
    message: str
    reason: StopReason | None = None

    def plain(self) -> dict[str, object]:
        """For a file."""
        return {
            "time": self.time,
            "kind": self.kind,
            "state": self.state.value,
            "message": self.message,
            "reason": None if self.reason is None else self.reason.value,
        }


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    reason, message: Why. ending: What was done with the torque; None if there was none. state: The last one.
    ticks: Turns of the loop while running. duration: s while running. overruns: Missed deadlines.
    """

    reason: StopReason
    message: str
    ending: Ending | None
    state: State
    ticks: int
    duration: float
    overruns: int

    @property
    def exit_code(self) -> int:
        """The program's exit code."""
        return self.reason.code


class Observer:
    """Someone who watches a run: a log, a view, a summary. The calls come from the loop and must return at once."""

    def on_start(self, start: Start, time: float) -> None:
        """The controller starts; `time` is the zero of the run's time on its clock, s."""

    def on_tick(self, tick: Tick) -> None:
        """A turn is over."""

    def on_event(self, event: Event) -> None:
        """Something happened."""

    def failure(self) -> str | None:
        """What is wrong with the observer so that the run must stop; None if nothing is."""
        return None
