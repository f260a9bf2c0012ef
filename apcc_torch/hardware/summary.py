"""A run in a few numbers, counted while it runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from apcc_torch.hardware.control import Decision
from apcc_torch.hardware.interfaces import Array
from apcc_torch.hardware.records import Event, Observer, Outcome, Tick
from apcc_torch.hardware.stage_times import StageTimes
from apcc_torch.hardware.states import State

STAGES = ("lateness", "read", "sense", "control", "send", "compute", "latency")
"""Times of a turn. `compute`: all stages of a turn with a step of the controller; `latency`: from that step's frame."""
LAST = 5.0
"""s at the end of which the largest error is told."""
PERIOD = 0.05
"""Least time between two decisions that are kept, s, until there are too many: then every other goes."""
DECISIONS = 4096
"""Most decisions that are kept, over the whole run."""
EVENTS = 10_000
"""Failed exchanges are kept among so many events; the log has all of them."""


class Summary(Observer):
    """Observes a run and keeps what its metrics need, in a memory that does not grow with the run.

    Args:
        truth: The true arm's coordinates (n,) at a frame, None where they are not known; see `World`.
    """

    def __init__(self, truth: Callable[[int], Array | None] = lambda sequence: None) -> None:
        self.truth = truth
        self.events: list[Event] = []
        self.first_error: float | None = None
        self.last_errors: deque[tuple[float, float]] = deque()  # time, s, and position error, m
        self.decisions: list[Decision] = []
        self.truths: list[Array | None] = []  # of each decision that is kept
        self.between = PERIOD
        self.times = {name: StageTimes() for name in STAGES}
        self.steps = self.incomplete = self.clamped = 0
        self.effort = 0.0

    def on_tick(self, tick: Tick) -> None:
        """Counts a turn of the loop; a turn of the hold is none."""
        if tick.state is not State.RUNNING:
            return
        self.times["lateness"].add(tick.lateness)
        for name in ("read", "sense", "send"):
            self.times[name].add(getattr(tick, name))
        if tick.frame is not None:
            self.incomplete += not tick.frame.complete
        if tick.reading is not None:
            self.effort = max(self.effort, float(tick.reading.effort.max()))
        if tick.fresh and tick.decision is not None:
            close = 1e-4 if tick.decision.pressure is None else 500.0  # m, or Pa
            self.clamped += bool(np.abs(tick.sent - tick.requested).max() > close)
        if tick.decision is not None and tick.frame is not None:
            self._error(tick.decision.time, float(np.linalg.norm(tick.decision.e)))
            self._decision(tick.decision, tick.frame.sequence)
            self.times["control"].add(tick.control)
            self.times["compute"].add(tick.read + tick.sense + tick.control + tick.send)
            if tick.latency is not None:
                self.times["latency"].add(tick.latency)

    def _decision(self, decision: Decision, sequence: int) -> None:
        if self.decisions and decision.time < self.decisions[-1].time + self.between:
            return
        self.decisions.append(decision)
        # A frame that is gone by now was of an arm that stood nearly so before.
        q = self.truth(sequence)
        self.truths.append(self.truths[-1] if q is None and self.truths else q)
        if len(self.decisions) > DECISIONS:
            self.decisions, self.truths = self.decisions[::2], self.truths[::2]
            self.between *= 2.0

    def _error(self, time: float, error: float) -> None:
        self.steps += 1
        if self.first_error is None:
            self.first_error = error
        self.last_errors.append((time, error))
        while self.last_errors[0][0] < time - LAST:
            self.last_errors.popleft()

    def on_event(self, event: Event) -> None:
        """Keeps the event; of failed exchanges, which can be many, not more than there is room for."""
        if len(self.events) < EVENTS or event.kind != "exchange_failed":
            self.events.append(event)

    def metrics(self, outcome: Outcome) -> dict[str, float]:
        """Flat metrics, SI units in the names."""
        metrics: dict[str, float] = {
            "exit_code": outcome.exit_code,
            "duration_s": outcome.duration,
            "turns": outcome.ticks,
            "control_steps": self.steps,
            "missed_deadlines": outcome.overruns,
            "incomplete_frames": self.incomplete,
            "clamped_share": self.clamped / max(self.steps, 1),
            "tension_max_N": self.effort,
        }
        if self.first_error is not None:
            metrics["end_effector_error_start_mm"] = 1e3 * self.first_error
            metrics["end_effector_error_end_mm"] = 1e3 * self.last_errors[-1][1]
            metrics["end_effector_error_last5s_max_mm"] = 1e3 * max(error for _, error in self.last_errors)
        for name, times in self.times.items():
            if times.count:
                metrics |= {
                    f"{name}_p50_us": 1e6 * times.percentile(50),
                    f"{name}_p99_us": 1e6 * times.percentile(99),
                    f"{name}_max_us": 1e6 * times.largest,
                }
        return {name: float(value) for name, value in metrics.items()}
