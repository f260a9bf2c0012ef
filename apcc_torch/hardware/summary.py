"""A run in a few numbers, counted while it runs."""

from __future__ import annotations

import numpy as np

from apcc_torch.hardware.control import Decision, Start
from apcc_torch.hardware.records import Event, Outcome, Tick
from apcc_torch.hardware.states import State

STAGES = ("lateness", "read", "sense", "control", "send", "compute", "latency")
"""Times of a turn. `compute`: all stages of a turn with a step of the controller; `latency`: from that step's frame."""


PERIOD = 0.05
"""Least time between two decisions that are kept, s: a run may last for hours."""


class Summary:
    """Observes a run and keeps what its metrics need."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.errors: list[tuple[float, float]] = []
        self.decisions: list[Decision] = []
        self.times: dict[str, list[float]] = {name: [] for name in STAGES}
        self.incomplete = self.clamped = 0
        self.effort = 0.0

    def on_start(self, start: Start, time: float) -> None:
        """Nothing to count yet."""

    def on_tick(self, tick: Tick) -> None:
        """Counts a turn of the loop; a turn of the hold is none."""
        if tick.state is not State.RUNNING:
            return
        self.times["lateness"].append(tick.lateness)
        for name in ("read", "sense", "send"):
            self.times[name].append(getattr(tick, name))
        if tick.frame is not None:
            self.incomplete += not tick.frame.complete
        if tick.reading is not None:
            self.effort = max(self.effort, float(tick.reading.effort.max()))
        if tick.fresh and tick.decision is not None:
            self.clamped += bool(np.abs(tick.sent - tick.requested).max() > 1e-4)
        if tick.decision is not None:
            self.errors.append((tick.decision.time, float(np.linalg.norm(tick.decision.e))))
            if not self.decisions or tick.decision.time >= self.decisions[-1].time + PERIOD:
                self.decisions.append(tick.decision)
            self.times["control"].append(tick.control)
            self.times["compute"].append(tick.read + tick.sense + tick.control + tick.send)
            if tick.latency is not None:
                self.times["latency"].append(tick.latency)

    def on_event(self, event: Event) -> None:
        """Keeps the event."""
        self.events.append(event)

    def failure(self) -> str | None:
        """Counting does not fail."""
        return None

    def metrics(self, outcome: Outcome) -> dict[str, float]:
        """Flat metrics, SI units in the names.

        Args:
            outcome: How the run ended.
        """
        steps = len(self.errors)
        metrics: dict[str, float] = {
            "exit_code": outcome.exit_code,
            "duration_s": outcome.duration,
            "turns": outcome.ticks,
            "control_steps": steps,
            "missed_deadlines": outcome.overruns,
            "incomplete_frames": self.incomplete,
            "clamped_share": self.clamped / max(steps, 1),
            "tension_max_N": self.effort,
        }
        if self.errors:
            e = np.array(self.errors)
            metrics["end_effector_error_start_mm"] = 1e3 * e[0, 1]
            metrics["end_effector_error_end_mm"] = 1e3 * e[-1, 1]
            metrics["end_effector_error_last5s_max_mm"] = 1e3 * float(e[e[:, 0] >= e[-1, 0] - 5.0, 1].max())
        for name, values in self.times.items():
            if values:
                p50, p99 = np.percentile(values, (50, 99))
                metrics |= {
                    f"{name}_p50_us": 1e6 * p50,
                    f"{name}_p99_us": 1e6 * p99,
                    f"{name}_max_us": 1e6 * max(values),
                }
        return {name: float(value) for name, value in metrics.items()}
