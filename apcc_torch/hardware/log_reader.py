"""Reads a run's log back, whole or cut off: what is there is there to the last bit."""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from struct import error as StructError
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from apcc_torch.errors import ConfigError, DataError
from apcc_torch.hardware.log_format import EVENT_TOPIC, layout_of

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RobotLog:
    """A run's log in memory.

    metadata: Name to names and texts. attachments: Name to a file's text. topics: Topic to a structured array (T,),
    columns as the log's message definitions say. events: In order. complete: Whether the file was finished; where not,
    all up to the cut is here.
    """

    metadata: dict[str, dict[str, str]]
    attachments: dict[str, str]
    topics: dict[str, NDArray[np.void]]
    events: list[dict[str, object]]
    complete: bool

    def topic(self, name: str) -> NDArray[np.void]:
        """The messages of a topic.

        Raises:
            DataError: The log has none.
        """
        if name not in self.topics:
            raise DataError(f"the log has no messages of {name}; it has {', '.join(sorted(self.topics)) or 'none'}")
        return self.topics[name]


def read_log(path: Path | str) -> RobotLog:
    """Reads a log, as far as it goes.

    Raises:
        ConfigError: mcap is not installed.
        DataError: There is no such file, or it is no log of a run.
    """
    try:
        with Path(path).open("rb") as file:
            records, complete = _records(file)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}") from error
    messages = records["Message"]
    if not (records["Metadata"] or messages):
        raise DataError(f"{path} is not the log of a run, or ends before anything was written")
    schemas = {record.id: record for record in records["Schema"]}
    channels = {record.id: record for record in records["Channel"]}
    rows: dict[int, list[bytes]] = defaultdict(list)
    for message in messages:
        rows[message.channel_id].append(message.data)
    topics: dict[str, NDArray[np.void]] = {}
    events: list[dict[str, object]] = []
    for number, content in rows.items():
        channel = channels[number]
        if channel.topic == EVENT_TOPIC:
            events = [json.loads(event) for event in content]
            continue
        schema = schemas[channel.schema_id]
        layout = layout_of(schema.name, channel.topic, schema.data.decode())
        # A device whose raw numbers changed during the run has two layouts; the first stands for the topic.
        topics.setdefault(channel.topic, layout.unpack(content))
    return RobotLog(
        {record.name: dict(record.metadata) for record in records["Metadata"]},
        {record.name: record.data.decode() for record in records["Attachment"]},
        topics,
        events,
        complete,
    )


def _records(file: IO[bytes]) -> tuple[dict[str, list[Any]], bool]:
    """The records by kind, up to where the file ends or is damaged, and whether that is its proper end."""
    try:
        from mcap.exceptions import McapError
        from mcap.stream_reader import CRCValidationError, StreamReader
        from zstandard import ZstdError
    except ImportError as error:
        raise ConfigError("reading a log needs mcap: pip install 'apcc-torch[log]'") from error
    kinds: dict[str, list[Any]] = defaultdict(list)
    try:
        for record in StreamReader(file, validate_crcs=True).records:
            kinds[type(record).__name__].append(record)
    except (McapError, ZstdError, CRCValidationError, StructError, UnicodeDecodeError) as error:
        # What came before is whole.
        log.info("the log ends early: %s", error)
        return kinds, False
    return kinds, True
