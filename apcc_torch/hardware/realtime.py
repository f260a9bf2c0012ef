"""The process as a real-time loop wants it: no garbage collection of what stays, one thread, priority if asked."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from apcc_torch.errors import HardwareError

SWITCH_INTERVAL = 5e-4
"""s for which another thread may keep the interpreter while the loop waits for it; Python's own is ten times that."""
MCL_CURRENT, MCL_FUTURE = 1, 2


@contextmanager
def realtime(priority: int | None = None, lock_memory: bool = False) -> Iterator[None]:
    """Prepares the process for a loop, and undoes it. To be entered in the loop's thread.

    Args:
        priority: Of SCHED_FIFO, 1 to 99; None leaves the scheduler alone.
        lock_memory: Keeps all memory in RAM.

    Raises:
        HardwareError: The system does not allow it.
    """
    interval, threads, frozen = sys.getswitchinterval(), torch.get_num_threads(), gc.get_freeze_count()
    sys.setswitchinterval(SWITCH_INTERVAL)
    torch.set_num_threads(1)
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        if lock_memory:
            _lock_memory()
        if priority is not None:
            _set_priority(priority)
        yield
    finally:
        if priority is not None:
            os.sched_setscheduler(0, *before)
        if not frozen:  # what the caller took out of sight stays there, and it cannot be told from the rest
            gc.unfreeze()
        torch.set_num_threads(threads)
        sys.setswitchinterval(interval)


def freeze() -> None:
    """Takes all that lives now out of the garbage collector's sight: for the moment between warm-up and torque."""
    gc.collect()
    gc.freeze()


def _set_priority(priority: int) -> None:
    try:
        # Threads and processes that start later do not inherit it.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, ValueError) as error:
        raise HardwareError(
            f"loop.priority={priority} was refused ({error}); allow it with a line `@realtime - rtprio 99` in "
            "/etc/security/limits.d, or set it to null"
        ) from error


def _lock_memory() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE) != 0:
        reason = os.strerror(ctypes.get_errno())
        raise HardwareError(
            f"loop.lock_memory was refused ({reason}); allow it with a line `@realtime - memlock unlimited` in "
            "/etc/security/limits.d, or set it to false"
        )
