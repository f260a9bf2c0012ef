"""Work for another process: it must be importable there."""

from __future__ import annotations

import logging
import os
import signal
import sys
from pathlib import Path

from apcc_torch.errors import ConfigError


def leaves(folder: Path, text: str) -> None:
    """Ends well, with a word on every channel."""
    (folder / "left.txt").write_text(text)
    sys.stdout.write(f"out {os.getpid()}\n")
    sys.stderr.write("err\n")
    logging.getLogger("apcc_torch.work").info("logged")


def refuses() -> None:
    """Meets a setting without meaning."""
    raise ConfigError("speed must be positive, got -1")


def breaks() -> None:
    """Has a bug."""
    raise ZeroDivisionError("nothing to divide by")


def is_killed() -> None:
    """Is ended as by an out-of-memory killer."""
    os.kill(os.getpid(), signal.SIGKILL)


def vanishes() -> None:
    """Ends without a word."""
    os._exit(7)
