"""What ends a run: limits on efforts, lengths, errors, deadlines and exchanges, each with its dwell or budget."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from apcc_torch.hardware.control import Decision
from apcc_torch.hardware.interfaces import TendonReading
from apcc_torch.hardware.limits import CommandLimits, CommandLimitSettings, PressureLimitSettings
from apcc_torch.hardware.sensing import SensingSettings
from apcc_torch.hardware.stops import Ending, Stop, StopReason
from apcc_torch.settings import OURS, PAPER, Settings, check_choice, setting


@dataclass(frozen=True, kw_only=True)
class GuardSettings(Settings):
    """What ends a run; null switches a guard off. Times suit a simulated arm on a busy machine."""

    limits: CommandLimitSettings = setting(factory=CommandLimitSettings, meaning="clamps of every command")
    pressures: PressureLimitSettings = setting(
        factory=PressureLimitSettings, meaning="of an arm with chambers, in place of `limits`"
    )
    sensing: SensingSettings = setting(factory=SensingSettings, meaning="frames and bodies to believe")
    arrival_error: float | None = setting(1e-3, "m", PAPER, "a set-point is reached", above=0)
    arrival_dwell: float = setting(0.5, "s", OURS, "that the error has to stay below", least=0)
    max_error: float | None = setting(1.0, "m", OURS, "position error that counts as divergence", above=0)
    effort_limit: float | None = setting(120.0, "N", OURS, "tension", above=0)
    effort_dwell: float = setting(0.3, "s", OURS, "above the limit", least=0)
    effort_cap: float | None = setting(250.0, "N", OURS, "tension, above it at once", above=0)
    slack_effort: float | None = setting(
        None,
        "N",
        OURS,
        "below it a tendon is slack; simulated tendons push as well, unless plant.transmission has slack",
    )
    slack_dwell: float = setting(0.5, "s", OURS, "below it", least=0)
    range_margin: float = setting(5e-3, "m", OURS, "by which a measured length may leave the commands' range", least=0)
    overruns: int = setting(100, "", OURS, "so many missed deadlines within the window are allowed", least=0)
    overrun_window: float = setting(1.0, "s", OURS, "of the missed deadlines", above=0)
    max_pause: float | None = setting(
        1.0, "s", OURS, "in which the loop may stand still, as a stopped process does", above=0
    )
    failed_exchanges: int = setting(5, "", OURS, "so many failed readings, or commands, in a row end the run", least=1)
    endings: Mapping[str, str] = setting(
        factory=dict, meaning="reason: hold or torque_off, where it is not the table's; see --help"
    )

    def check(self) -> None:
        """Raises ConfigError where no reason or no ending is named."""
        for name, ending in self.endings.items():
            check_choice("endings", name, [reason.value for reason in StopReason])
            check_choice(f"endings.{name}", ending, [each.value for each in Ending])

    def ending(self, reason: StopReason) -> Ending:
        """What a reason leads to."""
        return Ending(self.endings.get(reason.value, reason.ending.value))


class Dwell:
    """Whether a condition has held for longer than some time.

    Args:
        seconds: That time, s.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.since: float | None = None

    def over(self, condition: bool, now: float) -> bool:
        """Takes the condition at `now`, s; True once it has held for longer than the time."""
        if not condition:
            self.since = None
            return False
        if self.since is None:
            self.since = now
        return now - self.since >= self.seconds


class Guards:
    """The guards of one run with what they remember."""

    def __init__(self, settings: GuardSettings, limits: CommandLimits) -> None:
        self.settings = settings
        self.limits = limits
        self.effort = Dwell(settings.effort_dwell)
        self.slack = Dwell(settings.slack_dwell)
        self.arrival = Dwell(settings.arrival_dwell)
        self.failed_reads = self.failed_sends = 0
        self.missed: deque[tuple[float, int]] = deque()  # when, and how many

    def on_reading(self, reading: TendonReading, now: float) -> Stop | None:
        """Judges a reading at `now`, s."""
        s = self.settings
        self.failed_reads = 0
        limits = self.limits
        if not limits.inside(reading.y, s.range_margin if limits.margin is None else limits.margin):
            return Stop(
                StopReason.TENDON_RANGE, f"measured {limits.what} {limits.shown(reading.y)} have left their range"
            )
        largest, smallest = float(reading.effort.max()), float(reading.effort.min())
        if s.effort_cap is not None and not largest <= s.effort_cap:
            tendon = int(reading.effort.argmax()) + 1
            return Stop(StopReason.EFFORT_CAP, f"tendon {tendon} pulls {largest:.1f} N, the cap is {s.effort_cap:g} N")
        if s.effort_limit is not None and self.effort.over(not largest <= s.effort_limit, now):
            tendon = int(reading.effort.argmax()) + 1
            return Stop(
                StopReason.OVER_EFFORT, f"tendon {tendon} pulled {largest:.1f} N for {s.effort_dwell:g} s or longer"
            )
        if s.slack_effort is not None and self.slack.over(smallest < s.slack_effort, now):
            tendon = int(reading.effort.argmin()) + 1
            return Stop(StopReason.SLACK, f"tendon {tendon} was slack for {s.slack_dwell:g} s or longer")
        return None

    def on_decision(self, decision: Decision, now: float) -> Stop | None:
        """Judges a control step at `now`, s."""
        s = self.settings
        if not np.isfinite(decision.command).all():
            said = f"the controller wants {self.limits.what} {self.limits.shown(decision.command)}"
            return Stop(StopReason.COMMAND_NOT_FINITE, said)
        error = float(np.linalg.norm(decision.e))
        if s.max_error is not None and not error <= s.max_error:
            return Stop(StopReason.DIVERGENCE, f"the position error is {error:.3f} m, the limit {s.max_error:g} m")
        if s.arrival_error is not None and self.arrival.over(error <= s.arrival_error, now):
            return Stop(StopReason.ARRIVED, f"within {1e3 * s.arrival_error:g} mm for {s.arrival_dwell:g} s")
        return None

    @property
    def failed(self) -> int:
        """Failed exchanges in a row, of the kind that has more of them."""
        return max(self.failed_reads, self.failed_sends)

    def on_failed_read(self, error: Exception) -> Stop | None:
        """Counts a reading that failed; the next reading ends the row."""
        self.failed_reads += 1
        return self._too_many(self.failed_reads, "readings", error)

    def on_failed_send(self, error: Exception) -> Stop | None:
        """Counts a command that failed. `on_sent` ends the row, a reading does not: one can work without the other."""
        self.failed_sends += 1
        return self._too_many(self.failed_sends, "commands", error)

    def on_sent(self) -> None:
        """A command was sent."""
        self.failed_sends = 0

    def _too_many(self, count: int, what: str, error: Exception) -> Stop | None:
        if count < self.settings.failed_exchanges:
            return None
        return Stop(StopReason.COMMUNICATION, f"{count} {what} failed in a row, the last: {error}")

    def on_overrun(self, missed: int, now: float) -> Stop | None:
        """Counts deadlines that were missed up to `now`, s: a pause misses every one that falls into it."""
        if not missed:
            return None
        self.missed.append((now, missed))
        while now - self.missed[0][0] > self.settings.overrun_window:
            self.missed.popleft()
        count = sum(several for _, several in self.missed)
        if count <= self.settings.overruns:
            return None
        return Stop(StopReason.OVERRUN, f"{count} missed deadlines within {self.settings.overrun_window:g} s")

    def on_pause(self, seconds: float) -> Stop | None:
        """Judges the time since the loop was last seen to move, s."""
        longest = self.settings.max_pause
        if longest is None or seconds <= longest:
            return None
        return Stop(StopReason.PAUSED, f"the loop stood still for {seconds:.3f} s, the limit is {longest:g} s")
