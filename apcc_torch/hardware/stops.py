"""Why a run ends: every reason with its name, its exit code, and whether the arm is held or let go."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class Ending(Enum):
    """What happens to the arm at a stop. Torque off drops it; a hold keeps it where it is, and then lets go."""

    HOLD = "hold"
    TORQUE_OFF = "torque_off"


class StopReason(Enum):
    """A reason's value is its name in logs and settings; `code` the program's exit code."""

    ARRIVED = "arrived", 0, Ending.HOLD, "the end effector stayed within the arrival error"
    DURATION = "duration", 0, Ending.HOLD, "the duration of the run is over"
    COMPLETED = "completed", 0, Ending.TORQUE_OFF, "what was to be measured is measured"
    NOT_CONNECTED = "not_connected", 10, Ending.TORQUE_OFF, "a device is missing or is not the one configured"
    NOT_ARMED = "not_armed", 11, Ending.TORQUE_OFF, "a condition for torque was not met"
    SENSOR_LOST = "sensor_lost", 20, Ending.HOLD, "the source of poses ended"
    SENSOR_STALE = "sensor_stale", 21, Ending.HOLD, "no usable frame came for too long"
    SENSOR_DROPOUT = "sensor_dropout", 22, Ending.HOLD, "one body was not usable for too long"
    COMMUNICATION = "communication", 30, Ending.TORQUE_OFF, "too many failed exchanges with the motors in a row"
    DEVICE_FAULT = "device_fault", 31, Ending.TORQUE_OFF, "a motor reports a fault"
    OVER_EFFORT = "over_effort", 32, Ending.HOLD, "a tendon pulled above the limit for too long"
    EFFORT_CAP = "effort_cap", 33, Ending.TORQUE_OFF, "a tendon pulled above the cap"
    SLACK = "slack", 34, Ending.HOLD, "a tendon was slack for too long"
    TENDON_RANGE = "tendon_range", 35, Ending.HOLD, "a measured tendon length left its range"
    COMMAND_NOT_FINITE = "command_not_finite", 40, Ending.HOLD, "the controller's command was not finite"
    CONTROLLER_ERROR = "controller_error", 41, Ending.HOLD, "the controller refused its input"
    DIVERGENCE = "divergence", 42, Ending.HOLD, "the position error exceeded its limit"
    OVERRUN = "overrun", 50, Ending.HOLD, "the loop missed too many deadlines"
    PAUSED = "paused", 51, Ending.HOLD, "the loop stood still for too long"
    LOG_FAILED = "log_failed", 60, Ending.HOLD, "the log can no longer be written, as on a full disk"
    INTERNAL_ERROR = "internal_error", 70, Ending.TORQUE_OFF, "the program has an error; its log has the trace"
    INTERRUPTED = "interrupted", 130, Ending.HOLD, "Ctrl-C"
    TERMINATED = "terminated", 143, Ending.HOLD, "the system asked the program to end"

    code: int
    ending: Ending
    meaning: str

    @property
    def failed(self) -> bool:
        """Whether the run ended by a fault, not by its end or by someone's wish."""
        return self.code not in (0, 130, 143)

    def __new__(cls, value: str, code: int, ending: Ending, meaning: str) -> StopReason:
        """One row of the table."""
        reason = object.__new__(cls)
        reason._value_ = value
        reason.code = code
        reason.ending = ending
        reason.meaning = meaning
        return reason


class Stop(NamedTuple):
    """A reason and the sentence with the numbers."""

    reason: StopReason
    message: str


def exit_code_table() -> str:
    """The exit codes as aligned text, for a manual."""
    return "\n".join(f"{r.code:>3}  {r.value:<18}  {r.ending.value:<10}  {r.meaning}" for r in StopReason)


class Halt(Exception):  # noqa: N818 - it is no error
    """Carries a stop from where it is found to where the loop ends."""

    def __init__(self, stop: Stop) -> None:
        super().__init__(stop.message)
        self.stop = stop


def halt_if(stop: Stop | None) -> None:
    """Raises Halt with the stop, if there is one."""
    if stop is not None:
        raise Halt(stop)
