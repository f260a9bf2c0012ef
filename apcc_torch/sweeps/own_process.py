"""Work in a process of its own: whatever becomes of it, the caller goes on and can say what happened."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from apcc_torch.errors import ApccError
from apcc_torch.processes import deaf_children, end_with

# A clean process that has imported the toolkit once; each piece of work is forked from it in milliseconds. Forking the
# caller itself would copy locks held by its threads (a launcher's, a progress bar's).
_METHOD = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"


def run_isolated(work: Callable[..., object], arguments: Sequence[Any], log: Path) -> str | None:
    """Calls `work(*arguments)` in another process; all that it prints or logs goes to the end of the file `log`.

    Args:
        work: A function at the top of a module.
        arguments: What it takes; pickled.
        log: Log file.

    Returns:
        None if it returned, else one sentence: its error, or the signal that ended it.
    """
    context = multiprocessing.get_context(_METHOD)
    if multiprocessing.get_start_method() not in multiprocessing.get_all_start_methods():
        # A launcher's worker that was started by the launcher's own method, which the child would not know.
        multiprocessing.set_start_method(_METHOD, force=True)
    if _METHOD == "forkserver":
        context.set_forkserver_preload([work.__module__])
    here, there = context.Pipe(duplex=False)
    with deaf_children():
        process = context.Process(target=_child, args=(os.getpid(), work, tuple(arguments), str(log), there))  # type: ignore[attr-defined]
        process.start()
    there.close()
    try:
        process.join()
    except BaseException:
        process.kill()
        raise
    if process.exitcode == 0:
        return None
    if process.exitcode is not None and process.exitcode < 0:
        return f"killed by {signal.Signals(-process.exitcode).name}"
    try:
        return str(here.recv())
    except EOFError:  # it ended without a word
        return f"ended with exit code {process.exitcode}"


def _child(pid: int, work: Callable[..., object], arguments: tuple[Any, ...], log: str, told: Connection) -> None:
    end_with(pid)
    with open(log, "a", encoding="utf-8") as file:
        # Also what C libraries write, and a worker's last words.
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    logging.basicConfig(format="[%(asctime)s][%(name)s][%(levelname)s] - %(message)s", force=True)
    logging.getLogger("apcc_torch").setLevel(logging.INFO)
    try:
        work(*arguments)
    except ApccError as error:
        told.send(str(error))
        sys.exit(2)
    except Exception as error:
        # Told first: on a full disk the log does not take the stack.
        told.send(f"{type(error).__name__}: {error}"[:2000])  # fits the pipe, which nobody empties before the end
        with suppress(OSError):
            traceback.print_exc()
        sys.exit(1)
