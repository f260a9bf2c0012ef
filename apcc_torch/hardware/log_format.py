"""The messages of a run's log: fixed rows of numbers, described by a ROS 2 message definition and encoded as CDR.

Any MCAP tool reads them. Every number is a float64 or an int64, so a message is a four-byte header and its numbers as
they are in memory: nothing is rounded, and thousands a second cost next to nothing. Events are JSON.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apcc_torch.errors import DataError

HEADER = b"\x00\x01\x00\x00"
"""CDR: little endian, no options."""
FIELD = re.compile(r"(?P<kind>float64|int64)(\[(?P<size>\d{1,4})\])? (?P<name>[A-Za-z]\w{0,99})", re.ASCII)
"""A line of a message definition."""


class Field(NamedTuple):
    """One entry of a message. `size` None is a number, else a list of that length. `about`: unit and meaning."""

    name: str
    kind: str
    size: int | None
    about: str


@dataclass(frozen=True)
class Layout:
    """A kind of message.

    Names of fields are lower case with underscores, as ROS 2 has it.

    name: Of the type, in capitals and small letters. topic: Where it is published. fields: In order.
    """

    name: str
    topic: str
    fields: tuple[Field, ...]

    @property
    def schema_name(self) -> str:
        """The name of the message definition."""
        return f"apcc_torch/msg/{self.name}"

    @property
    def definition(self) -> str:
        """The ROS 2 message definition."""
        lines = []
        for field in self.fields:
            size = "" if field.size is None else f"[{field.size}]"
            lines.append(f"{field.kind}{size} {field.name}  # {field.about}")
        return "\n".join(lines) + "\n"

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The numbers of one message in memory."""
        kinds = {"float64": "<f8", "int64": "<i8"}
        return np.dtype([(f.name, kinds[f.kind], () if f.size is None else (f.size,)) for f in self.fields])

    def pack(self, *values: object) -> bytes:
        """One message of its fields' values, in order."""
        row = np.empty((), self.dtype)
        for field, value in zip(self.fields, values, strict=True):
            row[field.name] = np.asarray(value).reshape(() if field.size is None else (field.size,))
        return HEADER + row.tobytes()

    @property
    def length(self) -> int:
        """Bytes of a message."""
        return len(HEADER) + self.dtype.itemsize

    def unpack(self, messages: Sequence[bytes]) -> NDArray[np.void]:
        """All messages, each of `length` bytes, as one structured array (T,)."""
        return np.frombuffer(b"".join(message[len(HEADER) :] for message in messages), self.dtype)


def layout_of(schema_name: str, topic: str, definition: str) -> Layout:
    """The layout that a message definition describes; the reverse of `Layout.definition`.

    Raises:
        DataError: It describes no fields, two of one name, or what no log of a run holds.
    """
    fields: dict[str, Field] = {}
    for line in definition.strip().splitlines():
        declared, _, about = line.partition("  # ")
        found = FIELD.fullmatch(declared)
        if found is None or found["name"] in fields:
            raise DataError(f"{topic} is described by {declared[:60]!r}, which is no new field of numbers")
        size = None if found["size"] is None else int(found["size"])
        fields[found["name"]] = Field(found["name"], found["kind"], size, about)
    layout = Layout(schema_name.rpartition("/")[2], topic, tuple(fields.values()))
    if not layout.dtype.itemsize:
        raise DataError(f"{topic} is described by nothing")
    return layout


def _float(name: str, about: str, size: int | None = None) -> Field:
    return Field(name, "float64", size, about)


def _int(name: str, about: str, size: int | None = None) -> Field:
    return Field(name, "int64", size, about)


TICK = _int("tick", "number of the deadline on the loop's grid")
TIME = _float("time", "s since the start")

EVENT_TOPIC = "/events"
EVENT_SCHEMA = {
    "title": "Event",
    "type": "object",
    "properties": {
        "time": {"type": "number", "description": "s, clock of the run"},
        "kind": {"type": "string"},
        "state": {"type": "string"},
        "message": {"type": "string"},
        "reason": {"type": ["string", "null"]},
    },
    "required": ["time", "kind", "state", "message", "reason"],
}


class Layouts(NamedTuple):
    """The layouts of one run."""

    start: Layout
    measurement: Layout
    target: Layout
    controller: Layout
    tendons: Layout
    timing: Layout


def layouts(n: int, n_b: int, k: int, n_a: int, pressures: bool = False, ahead: bool = False) -> Layouts:
    """The layouts of an arm.

    Args:
        n: Coordinates of the configuration.
        n_b: Sections of the model.
        k: Bodies.
        n_a: Tendons, or chambers.
        pressures: Whether these are chambers, which are told pressures.
        ahead: Whether the controller looks ahead.
    """
    unit, what = ("Pa", "pressures") if pressures else ("m", "length changes")
    start = (
        _float("zero", "s, the zero of `time` on the clock of the run"),
        _float("first", "s, the controller's stamp before its first measurement"),
        _float("q", "rad, rad, m a section", n),
        _float("pi_hat", "m", n_b),
    )
    measurement = (
        TICK,
        TIME,
        _int("sequence", "the source's number of the frame"),
        _float("age", "s, when it was looked at"),
        _int("usable", "1: the controller may step on it"),
        _float("poses", "m, poses in the base frame, row by row; the last accepted where this one was not", 16 * k),
        _int("position_ok", "1: accepted", k),
        _int("orientation_ok", "1: accepted", k),
        _int("position_reason", "apcc_torch.estimation.sensor_gate.Reason", k),
        _int("orientation_reason", "apcc_torch.estimation.sensor_gate.Reason", k),
    )
    target = (TICK, TIME, _float("x_d", "m", 3), _float("xdot_d", "m/s", 3))
    controller = (
        TICK,
        TIME,
        _float("y", "m, wanted length changes", n_a),
        _float("e", "m, position error", 3),
        _float("q_bar", "rad, rad, m a section", n),
        _float("qdot", "per second", n),
        _float("q_d", "rad, rad, m a section", n),
        _float("pi_hat", "m", n_b),
        _int("status", "apcc_torch.estimation.state_feedback.FeedbackStatus"),
        _int("iterations", "of algorithm 2"),
        _float("angular_error", "rad", k),
        _float("linear_error", "m", k),
        *((_int("ahead", "apcc_torch.control.ahead.AheadStatus"),) if ahead else ()),
    )
    tendons = (
        TICK,
        TIME,
        _float("stamp", "s since the start, of the reading"),
        _float("y", f"{unit}, measured {what}", n_a),
        _float("ydot", f"{unit}/s", n_a),
        _float("effort", "N", n_a),
        _float("requested", f"{unit}, as the controller wants", n_a),
        _float("sent", f"{unit}, as it was really sent", n_a),
        _int("fresh", "1: sent in this turn"),
        _int("read", "1: read in this turn; 0: the numbers are the last reading's"),
    )
    timing = (
        TICK,
        TIME,
        _float("deadline", "s since the start"),
        _float("lateness", "s"),
        _float("read", "s, reading the tendons"),
        _float("sense", "s, taking and judging the frame"),
        _float("control", "s, the controller's step"),
        _float("send", "s, clamping and sending"),
        _float("latency", "s from the frame's stamp to the end of sending; NaN without a step"),
        _int("overruns", "missed deadlines so far"),
        _int("failed", "failed exchanges in a row"),
    )
    return Layouts(
        Layout("Start", "/start", start),
        Layout("Measurement", "/measurement", measurement),
        Layout("Target", "/target", target),
        Layout("Controller", "/controller", controller),
        Layout("Tendons", "/tendons", tendons),
        Layout("Timing", "/timing", timing),
    )


def raw_layout(raw: dict[str, list[int]]) -> Layout:
    """The layout of a device's own numbers."""
    return _raw_layout(tuple((name, len(values)) for name, values in raw.items()))


@cache
def _raw_layout(sizes: tuple[tuple[str, int], ...]) -> Layout:
    about = "as the device gives it"
    return Layout("RawTendons", "/tendons/raw", (TICK, TIME, *(_int(name, about, size) for name, size in sizes)))
