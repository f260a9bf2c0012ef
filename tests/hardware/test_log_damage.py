"""Logs that are damaged, or say what no run would: each is told in one sentence, and the rest is shown."""

from __future__ import annotations

import io
import json
import logging
import os
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from apcc_torch.experiments import realtime_run as realtime
from apcc_torch.hardware.log_reader import read_log
from apcc_torch.robot_log import main
from composed import composed_realtime

pytest.importorskip("mcap")

from mcap.records import Attachment, Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader

from mcap_mutations import mutated, records, written
from odd_values import seeds

QUICK = (
    "experiment=setpoint", "hardware=lockstep", "hardware.world.step=0.01", "plant.settle=0.1", "loop.hold=0.0",
    "figures=false", "loop.warm_up=3", "loop.fresh_frames=1", "experiment.duration=0.1", "view=false", "compile=off",
)  # fmt: skip
COMMANDS = ("replay", "parquet", "attachments", "parquet", "attachments")
"""Tried in turn; a replay takes the longest."""
MUTATIONS = 70
"""Damaged logs that are tried where nobody asks for more."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The log of a short run."""
    folder = tmp_path_factory.mktemp("whole")
    realtime.run(composed_realtime(*QUICK), folder)
    return (folder / "log.mcap").read_bytes()


def told(command: str, path: Path) -> tuple[int, str, str]:
    """Exit code, output and errors of the program."""
    out, err = io.StringIO(), io.StringIO()
    # Handlers that other programs of this process left write to streams that are closed.
    with redirect_stdout(out), redirect_stderr(err), patch.object(logging.root, "handlers", []):
        code = main([command, str(path)])
    return code, out.getvalue(), err.getvalue()


def test_whatever_the_damage_there_is_one_sentence(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a log\n.mcap"
    path.write_bytes(whole)
    assert told("info", path)[0] == told("replay", path)[0] == told("parquet", path)[0] == 0
    codes = set()
    for seed in seeds(MUTATIONS):
        path.write_bytes(mutated(whole, seed))
        for command in ("info", COMMANDS[seed % len(COMMANDS)]):
            try:
                code, out, err = told(command, path)
            except Exception as error:
                raise AssertionError(f"seed {seed}, {command}") from error
            codes.add(code)
            assert code in ((0, 1, 2) if command == "replay" else (0, 2)), seed
            assert err.count("\n") == (code == 2) + err.startswith(str(path)), seed
            assert (code == 2) == err.startswith(str(path)), (seed, err)
            assert all(c.isprintable() or c in "\n\t" for c in (out + err).replace("\u2028", "")), seed
    assert codes >= {0, 2}


def said(path: Path, command: str = "info") -> str:
    """What the program says of a damaged log, without the log's name."""
    code, _, err = told(command, path)
    assert code == 2 and err.startswith(f"{path}: ")
    return err.removeprefix(f"{path}: ").strip()


def changed(whole: bytes, path: Path, kind: type, change: Callable[[Any], None], topic: str | None = None) -> Path:
    """The log with a change to all its records of a kind, and of a topic."""
    parts = records(whole)
    channel = next((part.id for part in parts if isinstance(part, Channel) and part.topic == topic), None)
    for part in parts:
        if isinstance(part, kind) and channel in (None, getattr(part, "channel_id", None)):
            change(part)
    path.write_bytes(written(parts))
    return path


def set_data(data: bytes) -> Callable[[Any], None]:
    """Puts other bytes into a record."""
    return lambda part: setattr(part, "data", data)


def test_what_is_damaged_is_named_and_the_rest_is_shown(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    event = {"time": 1.0, "kind": "\x1b[2J", "state": "armed", "message": "here", "more": [1]}
    changed(whole, path, Message, set_data(json.dumps(event).encode()), "/events")
    assert said(path).startswith("an event has no readable reason")
    assert r"armed     \x1b[2J: here" in told("info", path)[1] and "/controller" in told("info", path)[1]
    assert told("replay", path)[1].strip().endswith("the same")
    changed(whole, path, Message, set_data(b"[1]"), "/events")
    assert said(path).startswith("an event holds no values by name")
    changed(whole, path, Attachment, set_data(b"\xff"))
    assert said(path) == "the attached config.yaml is not UTF-8"
    assert said(path, "replay").startswith("the log carries no settings")
    changed(whole, path, Attachment, set_data(b"a: &a [1]\nb: *a"))
    assert told("info", path)[0] == 0 and "refers to a part of itself" in said(path, "replay")
    changed(whole, path, Schema, set_data(b"string x\n"))
    assert "/start is described by 'string x', which is no new field of numbers" in said(path)
    changed(whole, path, Message, set_data(bytes(12)), "/target")
    assert "messages of /target are not as long as it is described" in said(path)
    assert "the log has no messages of /target" in said(path, "replay")


def test_a_damaged_chunk_costs_itself_alone(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    parts = records(whole)
    path.write_bytes(written(parts, chunk_size=600))
    data = bytearray(path.read_bytes())
    chunks = [
        record for record in StreamReader(io.BytesIO(data), emit_chunks=True).records if isinstance(record, Chunk)
    ]
    assert len(chunks) > 3
    at = data.index(chunks[2].data)
    data[at + len(chunks[2].data) // 2] ^= 0xFF
    path.write_bytes(data)
    assert "are left out" in said(path)
    lost, there = read_log(path), sum(isinstance(part, Message) for part in parts)
    assert 0 < there - sum(len(rows) for rows in lost.topics.values()) - len(lost.events) < there // 2


def test_a_length_beyond_the_file_takes_no_memory(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    for length in (2**27, 2**63, 2**64 - 1):
        path.write_bytes(whole[:8] + b"\x06" + length.to_bytes(8, "little") + bytes(40) + length.to_bytes(8, "little"))
        assert "is not the log of a run" in said(path)
    path.unlink()
    os.mkfifo(path)
    assert said(path) == "is no file"
