"""A run's log: an MCAP file, written by a thread of its own, so that no disk ever holds up the loop."""

from __future__ import annotations

import json
import queue
import threading
import time
from collections.abc import Mapping
from typing import IO

import numpy as np

from apcc_torch.errors import ConfigError
from apcc_torch.hardware.control import Start
from apcc_torch.hardware.interfaces import TendonReading
from apcc_torch.hardware.log_format import EVENT_SCHEMA, EVENT_TOPIC, Layout, Layouts, raw_layout
from apcc_torch.hardware.records import Event, Observer, Tick

FLUSH = 1.0
"""How often the file is brought up to date, s: a killed run loses no more than this."""
BACKLOG = 5000
"""Records that may wait before the log counts as failed."""


class RunLog(Observer):
    """Observes a run and writes it. `with` closes it; a failure to write never raises, it is `failure`.

    Args:
        stream: Where to; closed at the end.
        layouts: Of the arm.
        offset: What turns the run's clock into seconds since 1970: the stamps of the messages.
        metadata: Name to names and short texts, such as versions.
        attachments: Name to a whole file's text.

    Raises:
        ConfigError: mcap is not installed.
    """

    def __init__(
        self,
        stream: IO[bytes],
        layouts: Layouts,
        offset: float,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Mapping[str, str],
    ) -> None:
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise ConfigError("a log needs mcap: pip install 'apcc-torch[log]', or set log.file=false") from error
        self.stream = stream
        self.writer = Writer(stream)
        self.layouts = layouts
        self.offset = round(1e9 * offset)
        self.metadata = metadata
        self.attachments = attachments
        self.zero = 0.0
        self.last: TendonReading | None = None
        self.failed: str | None = None
        self.channels: dict[Layout | str, int] = {}
        self.queue: queue.SimpleQueue[Start | Tick | Event | None] = queue.SimpleQueue()
        self.thread = threading.Thread(target=self._work, name="log", daemon=True)
        self.thread.start()

    # From the loop

    def on_start(self, start: Start, time: float) -> None:
        """The controller starts."""
        self.zero = time
        self.queue.put(start)

    def on_tick(self, tick: Tick) -> None:
        """A turn is over; nobody changes it any more."""
        self.queue.put(tick)

    def on_event(self, event: Event) -> None:
        """Something happened."""
        self.queue.put(event)

    def failure(self) -> str | None:
        """Why the log can no longer be written; None if it can."""
        if self.failed is None and self.queue.qsize() > BACKLOG:
            self.failed = f"the log is {BACKLOG} records behind"
        return self.failed

    def close(self) -> None:
        """Writes what is left, and the end of the file."""
        self.queue.put(None)
        self.thread.join()

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()

    # In the thread

    def _work(self) -> None:
        try:
            with self.stream:
                self._write_all()
        except OSError as error:
            self.failed = f"the log cannot be written: {error}"

    def _write_all(self) -> None:
        writer = self.writer
        writer.start(library="apcc_torch")
        for name, entries in self.metadata.items():
            writer.add_metadata(name, dict(entries))
        for name, text in self.attachments.items():
            writer.add_attachment(time.time_ns(), time.time_ns(), name, "text/plain", text.encode())
        flushed = time.monotonic()
        while (record := self.queue.get()) is not None:
            self._write(record)
            if time.monotonic() - flushed > FLUSH:
                writer.flush()
                flushed = time.monotonic()
        writer.finish()
        self.stream.flush()

    def _write(self, record: Start | Tick | Event) -> None:
        if isinstance(record, Event):
            self._event(record)
        elif isinstance(record, Start):
            self._add(self.layouts.start, self.zero, 0, self.zero, record.time, record.q, record.pi_hat)
        else:
            self._tick(record)

    def _event(self, event: Event) -> None:
        if EVENT_TOPIC not in self.channels:
            schema = self.writer.register_schema("Event", "jsonschema", json.dumps(EVENT_SCHEMA).encode())
            self.channels[EVENT_TOPIC] = self.writer.register_channel(EVENT_TOPIC, "json", schema)
        stamp = self._stamp(event.time)
        self.writer.add_message(self.channels[EVENT_TOPIC], stamp, json.dumps(event.plain()).encode(), stamp)

    def _stamp(self, seconds: float) -> int:
        return max(round(1e9 * seconds) + self.offset, 0)

    def _add(self, layout: Layout, now: float, sequence: int, *values: object) -> None:
        if layout not in self.channels:
            schema = self.writer.register_schema(layout.schema_name, "ros2msg", layout.definition.encode())
            self.channels[layout] = self.writer.register_channel(layout.topic, "cdr", schema)
        stamp = self._stamp(now)
        self.writer.add_message(self.channels[layout], stamp, layout.pack(*values), stamp, sequence)

    def _tick(self, t: Tick) -> None:
        number = (t.now, t.index % 2**32)
        frame, decision, reading = t.frame, t.decision, t.reading
        if frame is not None:
            masks = frame.position_ok, frame.orientation_ok, frame.position_reason, frame.orientation_reason
            values = (frame.stamp - self.zero, frame.sequence, frame.age, frame.usable, frame.T)
            self._add(self.layouts.measurement, *number, t.index, *values, *masks)
        if decision is not None:
            d = decision
            self._add(self.layouts.target, *number, t.index, d.time, d.x_d, d.xdot_d)
            inferred = d.q_bar, d.qdot, d.q_d, d.pi_hat, d.status, d.iterations, d.angular_error, d.linear_error
            ahead = () if d.ahead is None else (d.ahead,)
            self._add(self.layouts.controller, *number, t.index, d.time, d.y, d.e, *inferred, *ahead)
        if reading is not None:
            self.last = reading
            self._add(raw_layout(reading.raw), *number, t.index, t.time, *reading.raw.values())
        unknown = np.full_like(t.requested, np.nan)
        measured = (np.nan, unknown, unknown, unknown)  # before the first reading
        if self.last is not None:
            measured = self.last.stamp - self.zero, self.last.y, self.last.ydot, self.last.effort
        done = t.requested, t.sent, t.fresh, reading is not None
        self._add(self.layouts.tendons, *number, t.index, t.time, *measured, *done)
        latency = np.nan if t.latency is None else t.latency
        stages = t.lateness, t.read, t.sense, t.control, t.send, latency, t.overruns, t.failed
        self._add(self.layouts.timing, *number, t.index, t.time, t.deadline - self.zero, *stages)
