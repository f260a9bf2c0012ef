"""Values and texts that files from elsewhere may hold where others belong, by a seed."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from random import Random
from typing import Any

TEXTS = (
    "", " ", "\n", "a\nb", "\x1b[2J\x1b]0;title\x07", "=1+1", "@SUM(A1)", "-x", "\u202eabc", "\ud800", "\0",
    "ü", "\U0001f916", "x" * 5000, "../../etc/passwd", "<script>alert(1)</script>", "nan", "1e999", "&a [*a]",
    "${seed}", "!!python/object:os.system x", "[" * 2000, "{a: " * 2000, "2026-13-45", "1:1" + ":1" * 400, "9" * 5000,
    "0x" + "f" * 5000, "'", '"', "%s%n", "---", "*a",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 10**400, -(10**20), 2**63, 1e308, float("inf"), float("nan"), [], {}, [1.0, "a", None],
    {"a": {"b": []}}, [[]], "0.5", 0.5, [0.1] * 4, -0.0, 10**15,
)  # fmt: skip


def seeds(few: int) -> range:
    """Of the damage that a test tries: `few`, or what APCC_MUTATIONS names, as in 10000 or 2000-4000."""
    first, _, last = os.environ.get("APCC_MUTATIONS", str(few)).rpartition("-")
    return range(int(first or 0), int(last))


def odd_text(random: Random) -> str:
    """One of the texts."""
    return random.choice(TEXTS)


def odd_value(random: Random) -> Any:
    """One of the values, or of the texts."""
    return random.choice(VALUES) if random.random() < 0.7 else odd_text(random)


def odd_mapping(values: Mapping[str, Any], random: Random) -> bytes:
    """A JSON file of the values, one of which is missing, is another, is added, or the whole of which is no JSON."""
    changed = dict(values)
    key = random.choice(list(changed) or ["a"])
    match random.randrange(6):
        case 0:
            changed.pop(key, None)
        case 1:
            changed[odd_text(random)] = odd_value(random)
        case 2 | 3:
            changed[key] = odd_value(random)
        case 4:
            return _json(odd_value(random))
        case _:
            whole = _json(changed)
            at = random.randrange(len(whole))
            return random.choice((b"", b"\xff\xfe", whole[:at], b"[" * 100_000, b"\0" * 9, b"\xef\xbb\xbf" + whole))
    return _json(changed)


def damaged_bytes(content: bytes, random: Random) -> bytes:
    """The file with a few bytes other than they were."""
    data = bytearray(content)
    at, length = random.randrange(len(data)), random.choice((1, 2, 8, 100, 4000))
    match random.randrange(6):
        case 0:
            for _ in range(random.choice((1, 3, 20))):
                data[random.randrange(len(data))] ^= 1 << random.randrange(8)
        case 1:
            del data[at:]
        case 2:
            del data[at : at + length]
        case 3:
            data[at:at] = random.randbytes(length)
        case 4:
            data[at : at + length] = bytes(length)
        case _:
            data[at:at] = data[at : at + length]
    return bytes(data)


def _json(value: Any) -> bytes:
    return json.dumps(value).encode()
