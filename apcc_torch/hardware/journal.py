"""The state of a run, and everyone who is told of it."""

from __future__ import annotations

from collections.abc import Sequence

from apcc_torch.hardware.clock import Clock
from apcc_torch.hardware.control import Start
from apcc_torch.hardware.records import Event, Observer, Tick
from apcc_torch.hardware.states import State, StateMachine
from apcc_torch.hardware.stops import Stop, StopReason


class Journal:
    """Passes what happens on to the observers, with the state it happened in.

    Args:
        clock: Of the events' times.
        observers: Told in this order.
    """

    def __init__(self, clock: Clock, observers: Sequence[Observer]) -> None:
        self.clock = clock
        self.observers = observers
        self.machine = StateMachine()

    @property
    def state(self) -> State:
        """The state of the run."""
        return self.machine.state

    def event(self, kind: str, message: str, reason: StopReason | None = None) -> None:
        """Something happened."""
        event = Event(self.clock.now(), kind, self.state, message, reason)
        for observer in self.observers:
            observer.on_event(event)

    def to(self, state: State, message: str, reason: StopReason | None = None) -> None:
        """The run goes to another state.

        Raises:
            SafetyError: It cannot.
        """
        self.machine.to(state)
        self.event("state", message, reason)

    def start(self, start: Start, time: float) -> None:
        """The controller starts; `time` is the zero of the run's time, s."""
        for observer in self.observers:
            observer.on_start(start, time)

    def tick(self, tick: Tick) -> None:
        """A turn is over."""
        for observer in self.observers:
            observer.on_tick(tick)

    def failure(self) -> Stop | None:
        """A stop if an observer has failed."""
        failures = (observer.failure() for observer in self.observers)
        first = next((failure for failure in failures if failure is not None), None)
        return None if first is None else Stop(StopReason.LOG_FAILED, first)
