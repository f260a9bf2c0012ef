"""Damaged logs, made from a good one by a seed: bytes that changed on a disk, and records that say something else."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from random import Random
from typing import Any

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from odd_values import damaged_bytes, odd_mapping, odd_text, odd_value

Records = list[Any]


def records(content: bytes) -> Records:
    """What a log holds, without its indices."""
    kinds = (Attachment, Channel, Message, Metadata, Schema)
    return [record for record in StreamReader(io.BytesIO(content)).records if isinstance(record, kinds)]


def written(parts: Records, chunk_size: int = 2**20) -> bytes:
    """A sound file of the records."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size)
    writer.start(library="apcc_torch")
    schemas, channels = {0: 0}, {}
    for part in parts:
        if isinstance(part, Metadata):
            writer.add_metadata(part.name, part.metadata)
        elif isinstance(part, Attachment):
            writer.add_attachment(1, 1, part.name, part.media_type, part.data)
        elif isinstance(part, Schema):
            schemas[part.id] = writer.register_schema(part.name, part.encoding, part.data)
        elif isinstance(part, Channel):
            channels[part.id] = writer.register_channel(part.topic, part.message_encoding, schemas[part.schema_id])
        else:
            writer.add_message(channels[part.channel_id], part.log_time, part.data, part.publish_time, part.sequence)
    writer.finish()
    return stream.getvalue()


EVENT = {"time": 1.0, "kind": "state", "state": "hold", "message": "arrived", "reason": "arrived"}


def _event(parts: Records, random: Random) -> None:
    channel = next(part for part in parts if isinstance(part, Channel) and part.topic == "/events")
    part = random.choice([p for p in parts if isinstance(p, Message) and p.channel_id == channel.id])
    part.data = odd_mapping(EVENT, random)


def _attachment(parts: Records, random: Random) -> None:
    part = random.choice([part for part in parts if isinstance(part, Attachment)])
    match random.randrange(5):
        case 0:
            part.name = odd_text(random).encode("utf-8", "replace").decode()
        case 1:
            part.data = random.choice((b"\xff\xfe", b"", odd_text(random).encode("utf-8", "surrogatepass")))
        case _:
            lines = part.data.decode(errors="replace").splitlines() or [""]
            k = random.randrange(len(lines))
            key, colon, _ = lines[k].partition(":")
            value = json.dumps(odd_value(random), default=str)
            lines[k : k + 1] = random.choice(([], [lines[k]] * 2, [f"{key}{colon} {value}"], [f"{key}x: 1"]))
            part.data = "\n".join(lines).encode("utf-8", "surrogatepass")


def _schema(parts: Records, random: Random) -> None:
    part = random.choice([part for part in parts if isinstance(part, Schema)])
    lines = part.data.decode(errors="replace").splitlines() or [""]
    k = random.randrange(len(lines))
    line = random.choice(("int8 x", "float64[9999] x", "float64 x[3]", "", "int64[-1] x", "string x", odd_text(random)))
    lines[k : k + 1] = random.choice(([], [lines[k]] * 2, [line], [lines[k].replace("float64", "int64")]))
    part.data = random.choice(("\n".join(lines).encode("utf-8", "surrogatepass"), random.randbytes(20), b""))


def _message(parts: Records, random: Random) -> None:
    channel = random.choice([part for part in parts if isinstance(part, Channel)])
    of_it = [part for part in parts if isinstance(part, Message) and part.channel_id == channel.id]
    for part in random.choice((of_it, [random.choice(of_it)])):
        match random.randrange(5):
            case 0:
                parts.remove(part)
            case 1:
                part.data = part.data[: random.randrange(len(part.data) + 1)]
            case 2:
                part.data += bytes(8)
            case 3:
                k = 4 + 8 * random.randrange(max(1, len(part.data) // 8))
                part.data = (
                    part.data[:k] + random.choice((b"\xff" * 8, random.randbytes(8), bytes(8))) + part.data[k + 8 :]
                )
            case _:
                part.data = part.data[:4] + random.randbytes(len(part.data[4:]))


def _names(parts: Records, random: Random) -> None:
    part = random.choice([part for part in parts if isinstance(part, Channel | Metadata | Schema)])
    text = random.choice((odd_text(random).encode("utf-8", "replace").decode(), "/controller", "events", "../../up"))
    match part:
        case Channel():
            part.topic = text
        case Metadata():
            part.metadata = {text: text}
        case _:
            part.name = text


SAYING: tuple[Callable[[Records, Random], None], ...] = (_event, _attachment, _attachment, _schema, _message, _names)


def mutated(content: bytes, seed: int) -> bytes:
    """The log, damaged as the seed says."""
    random = Random(seed)
    if random.random() < 0.4:
        return damaged_bytes(content, random)
    parts = records(content)
    for _ in range(random.choice((1, 1, 2))):
        random.choice(SAYING)(parts, random)
    return written(parts)
