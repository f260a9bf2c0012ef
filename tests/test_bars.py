"""Bars: there on a terminal that does not say its size, and not there without one."""

from __future__ import annotations

import fcntl
import io
import os
import pty
import struct
import termios
from contextlib import suppress

import pytest

from apcc_torch.bars import COLUMNS, LINES, size_of, terminal_bar


@pytest.mark.parametrize(
    ("rows", "columns", "told"),
    [(0, 0, {"ncols": COLUMNS, "nrows": LINES}), (50, 100, {"dynamic_ncols": True})],
)
def test_a_bar_is_drawn_whatever_the_terminal_says(rows: int, columns: int, told: dict[str, object]) -> None:
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    with os.fdopen(slave, "w") as terminal:
        assert size_of(terminal) == told
        assert list(terminal_bar(range(3), desc="steps", file=terminal, mininterval=0.0)) == [0, 1, 2]
    drawn = b""
    with suppress(OSError):  # nothing is left, and nobody writes any more
        while more := os.read(master, 10_000):
            drawn += more
    os.close(master)
    assert b"steps" in drawn and b"100%" in drawn and b"|" in drawn


def test_there_is_none_without_a_terminal() -> None:
    file = io.StringIO()
    assert list(terminal_bar(range(3), file=file)) == [0, 1, 2] and not file.getvalue()
