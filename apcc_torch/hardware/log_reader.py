"""Reads a run's log back, whole, cut off or damaged: what is there is there to the last bit."""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apcc_torch.errors import ConfigError, DataError, in_a_line
from apcc_torch.files import json_in
from apcc_torch.hardware.log_format import EVENT_TOPIC, Layout, layout_of
from apcc_torch.plain_text import plain_logger

log = plain_logger(__name__)

EVENT: dict[str, tuple[type, ...]] = {
    "time": (float, int),
    "kind": (str,),
    "state": (str,),
    "message": (str,),
    "reason": (str, type(None)),
}
"""What an event has, and of which types."""
LATEST = 2**62
"""Latest stamp, ns since 1970."""
LARGEST = 2**28
"""Largest record of a log that is read, and largest chunk once it is unpacked, bytes."""


@dataclass(frozen=True)
class RobotLog:
    """A run's log in memory.

    metadata: Name to names and texts. attachments: Name to a file's text. topics: Topic to a structured array (T,),
    columns as the log's message definitions say. events: In order. complete: Whether the file was finished; where not,
    all up to the cut is here. damage: A clause for each thing that cannot be read and is left out, or is not as it was
    written. stamps: Topic to (T,) ns since 1970, when each of its messages was logged; `EVENT_TOPIC` has the events'.
    layouts: Topic to how its messages are laid out.
    """

    metadata: dict[str, dict[str, str]]
    attachments: dict[str, str]
    topics: dict[str, NDArray[np.void]]
    events: list[dict[str, object]]
    complete: bool
    damage: list[str] = field(default_factory=list)
    stamps: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    layouts: dict[str, Layout] = field(default_factory=dict)

    @property
    def of_pressures(self) -> bool:
        """Whether its actuators are chambers, told and read in Pa, in place of tendons in m."""
        layout = self.layouts.get("/tendons")
        return layout is not None and any(f.name == "sent" and f.about.startswith("Pa") for f in layout.fields)

    @property
    def began(self) -> int:
        """When the run's time was zero, ns since 1970.

        Raises:
            DataError: No message tells.
        """
        # The start is stamped with it; every turn's stamp is that of its `time`, to what a float64 of seconds holds.
        for topic, field_name in (("/start", None), ("/timing", "time"), ("/tendons", "time")):
            rows, stamps = self.topics.get(topic), self.stamps.get(topic)
            if rows is None or stamps is None or not len(rows):
                continue
            if field_name is None:
                return int(stamps[0])
            times = rows[field_name] if field_name in (rows.dtype.names or ()) else rows[:0]
            if times.dtype == np.float64 and times.ndim == 1 and np.isfinite(times).any():
                k = int(np.isfinite(times).argmax())
                return int(stamps[k]) - round(1e9 * float(times[k]))
        raise DataError("the log has no /start, /timing or /tendons, so nobody knows when its time began")

    def topic(self, name: str) -> NDArray[np.void]:
        """The messages of a topic.

        Raises:
            DataError: The log has none.
        """
        if name not in self.topics:
            raise DataError(f"the log has no messages of {name}; it has {', '.join(sorted(self.topics)) or 'none'}")
        return self.topics[name]

    def rows(self, layout: Layout, *fields: str) -> NDArray[np.void]:
        """The messages of a topic, of which some fields are needed as a layout has them.

        Raises:
            DataError: The log has none, or they lack a field, or it is of another size.
        """
        rows = self.topic(layout.topic)
        for name in fields:
            if name not in (rows.dtype.names or ()) or rows.dtype[name] != layout.dtype[name]:
                raise DataError(f"{layout.topic} of the log has no {name} as the arm of its settings needs it")
        return rows


def read_log(path: Path | str) -> RobotLog:
    """Reads a log, as far as it goes. What is damaged is left out and named in `RobotLog.damage`.

    Raises:
        ConfigError: mcap is not installed.
        DataError: There is no such file, or it is no log of a run.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():
            raise DataError(f"{path} is no file")
        with path.open("rb") as file:
            found = _records(file)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}") from error
    if not (found.kinds["Metadata"] or found.kinds["Message"]):
        raise DataError(f"{path} is not the log of a run, or ends before anything was written")
    damage = found.damage
    told = _topics(found.kinds, damage)
    attachments = {}
    for record in found.kinds["Attachment"]:
        try:
            attachments[record.name] = record.data.decode()
        except UnicodeDecodeError:
            damage.append(f"the attached {record.name} is not UTF-8")
    metadata = {record.name: dict(record.metadata) for record in found.kinds["Metadata"]}
    return RobotLog(metadata, attachments, told.topics, told.events, found.complete, damage, told.stamps, told.layouts)


class _Told(NamedTuple):
    """What the messages say; see `RobotLog`."""

    topics: dict[str, NDArray[np.void]]
    events: list[dict[str, object]]
    stamps: dict[str, NDArray[np.int64]]
    layouts: dict[str, Layout]


def _topics(kinds: dict[str, list[Any]], damage: list[str]) -> _Told:
    """Arrays by topic, and the events."""
    schemas = {record.id: record for record in kinds["Schema"]}
    channels = {record.id: record for record in kinds["Channel"]}
    messages: dict[int, list[Any]] = defaultdict(list)
    for message in kinds["Message"]:
        messages[message.channel_id].append(message)
    told = _Told({}, [], {}, {})
    for number, content in messages.items():
        channel = channels.get(number)
        schema = None if channel is None else schemas.get(channel.schema_id)
        if channel is None or schema is None:
            damage.append(f"{len(content)} messages are of a kind that is not described")
        elif channel.topic == EVENT_TOPIC:
            read = [(message.log_time, _event(message.data, damage)) for message in content]
            told.events.extend(event for _, event in read if event is not None)
            earlier = told.stamps.get(EVENT_TOPIC, ())
            told.stamps[EVENT_TOPIC] = _stamps([*earlier, *(stamp for stamp, event in read if event is not None)])
        else:
            try:
                layout = layout_of(schema.name, channel.topic, schema.data.decode())
            except (DataError, UnicodeDecodeError) as error:
                damage.append(in_a_line(error))
                continue
            # A device whose raw numbers changed during the run has two layouts; the first stands for the topic.
            whole = _whole(layout, content, damage)
            if whole and channel.topic not in told.topics:
                told.topics[channel.topic] = layout.unpack([message.data for message in whole])
                told.stamps[channel.topic] = _stamps([message.log_time for message in whole])
                told.layouts[channel.topic] = layout
    return told


def _whole(layout: Layout, messages: Sequence[Any], damage: list[str]) -> list[Any]:
    """The messages that are as long as their layout says."""
    length = layout.length
    whole = [message for message in messages if len(message.data) == length]
    if len(whole) < len(messages):
        damage.append(f"{len(messages) - len(whole)} messages of {layout.topic} are not as long as it is described")
    return whole


def _stamps(stamps: Sequence[int]) -> NDArray[np.int64]:
    # A file may say any uint64; what no int64 holds is later than any log.
    return np.minimum(np.array(stamps, dtype=np.uint64), np.uint64(LATEST)).astype(np.int64)


def _event(content: bytes, damage: list[str]) -> dict[str, object] | None:
    """An event, what it lacks empty; None if it cannot be read at all."""
    try:
        told = json_in(content.decode(), "an event")
    except (DataError, UnicodeDecodeError) as error:
        damage.append(in_a_line(error))
        return None
    if not isinstance(told, dict):
        damage.append("an event holds no values by name")
        return None
    lacking = [key for key, kinds in EVENT.items() if type(told.get(key, ...)) not in kinds]
    if lacking:
        damage.append(f"an event has no readable {', '.join(lacking)}")
    event = {"time": math.nan, "kind": "", "state": "", "message": "", "reason": None}
    event |= {key: told[key] for key in EVENT if key not in lacking}
    return event | {"time": float(event["time"])}  # type: ignore[arg-type]


class _Found(NamedTuple):
    """The records of a file by kind, whether it ends properly, and what is damaged."""

    kinds: dict[str, list[Any]]
    complete: bool
    damage: list[str]


class _ToTheEnd:
    """A file that is never asked for more than it has: a damaged length must not take the memory it names."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file = file
        self.left = os.fstat(file.fileno()).st_size

    def read(self, length: int) -> bytes:
        """Up to so many bytes."""
        content = self.file.read(min(length, self.left))
        self.left -= len(content)
        return content


def _records(file: IO[bytes]) -> _Found:
    """The records, up to where the file ends or is damaged; a damaged chunk is left out alone."""
    try:
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk
    except ImportError as error:
        raise ConfigError("reading a log needs mcap: pip install 'apcc-torch[log]'") from error
    kinds: dict[str, list[Any]] = defaultdict(list)
    damage: list[str] = []
    stream = _ToTheEnd(file)
    reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=LARGEST)  # type: ignore[arg-type]
    try:
        for record in reader.records:
            if not isinstance(record, Chunk):
                kinds[type(record).__name__].append(record)
                continue
            try:
                _check_size(record)
                inner = breakup_chunk(record, validate_crc=True)
            except Exception as error:  # as below; what is around the chunk is whole
                if not stream.left:
                    raise
                damage.append(f"the messages from {_clock(record)} are left out: {in_a_line(error)}")
                continue
            for each in inner:
                kinds[type(each).__name__].append(each)
    except Exception as error:  # mcap, struct and zstandard raise a dozen kinds for damaged bytes
        # What came before is whole. A run that was killed ends in the middle of a record.
        log.info("the log ends early: %s", in_a_line(error))
        if stream.left:
            damage.append(f"it cannot be read to its end, of which {stream.left} bytes are left: {in_a_line(error)}")
        return _Found(kinds, False, damage)
    return _Found(kinds, True, damage)


def _check_size(chunk: Any) -> None:
    from zstandard import frame_content_size

    if chunk.compression not in ("", "zstd"):
        raise DataError(f"it is packed by {chunk.compression!r}, and logs of runs by zstd")
    unpacked = frame_content_size(chunk.data) if chunk.compression else 0
    if max(unpacked, chunk.uncompressed_size) > LARGEST:
        raise DataError(f"it has over {LARGEST / 2**20:g} MiB")


def _clock(chunk: Any) -> str:
    return f"{1e-9 * chunk.message_start_time:.3f} s to {1e-9 * chunk.message_end_time:.3f} s since 1970"
