"""Processes that end together: workers with the one that began them, and a program at Ctrl-C, SIGTERM or SIGHUP."""

from __future__ import annotations

import multiprocessing
import os
import select
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any

NAMES = {"SIGINT": "Ctrl-C", "SIGTERM": "SIGTERM", "SIGHUP": "a closed terminal"}
"""What stops a program, by the name of its signal."""


class Stopped(KeyboardInterrupt):
    """The program was asked to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number
        self.by = NAMES[signal.Signals(number).name]


@contextmanager
def stoppable(told: Callable[[str], object]) -> Iterator[None]:
    """Ends a program that is asked to end with 128 + the signal's number, as a shell has it, and without a stack.

    Args:
        told: Called before it ends, with what asked for it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread hears signals
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise Stopped(number)

    # What is ignored, as nohup has it, stays ignored.
    before = {number: signal.getsignal(number) for name in NAMES if (number := getattr(signal, name, None))}
    heard = [number for number, by in before.items() if by in (signal.SIG_DFL, signal.default_int_handler)]
    for number in heard:
        signal.signal(number, stop)
    try:
        yield
    except KeyboardInterrupt as error:
        stopped = error if isinstance(error, Stopped) else Stopped(signal.SIGINT)
        for number in heard:
            signal.signal(number, signal.SIG_IGN)  # often it is sent twice: to the program, and to its group
        _end_children()  # else the interpreter would wait for their work
        told(stopped.by)
        sys.exit(stopped.code)
    finally:
        for number in heard:
            signal.signal(number, before[number])


def again(*changes: str) -> str:
    """The command that began this program, with keys changed, to be pasted into a shell."""
    keys = {change.partition("=")[0] for change in changes}
    kept = [word for word in sys.orig_argv if word.partition("=")[0].lstrip("+") not in keys]
    # Beside the others: hydra takes no key behind an option that follows keys.
    at = max((i for i, word in enumerate(kept, 1) if "=" in word and not word.startswith("-")), default=len(kept))
    return shlex.join([*kept[:at], *changes, *kept[at:]])


def end_with(pid: int) -> None:
    """Ends this process as soon as another one of this machine has ended, however that ended."""
    threading.Thread(target=_end_after, args=(pid,), name=f"ends with {pid}", daemon=True).start()


def _end_after(pid: int) -> None:
    try:
        waiting = select.poll()
        waiting.register(os.pidfd_open(pid), select.POLLIN)
        waiting.poll()
    except ProcessLookupError:
        pass  # it has ended already
    except (AttributeError, OSError):  # not Linux, or not allowed there
        while _lives(pid):
            time.sleep(0.5)
    os._exit(1)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # it is another user's
    return True


@contextmanager
def deaf_children() -> Iterator[None]:
    """Processes that begin in this block do not hear Ctrl-C, which a terminal sends to all: their parent ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # its start, which a first child brings about, would unblock the signal
    # A blocked signal is inherited, and one that comes meanwhile is kept for this process.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Pool(ProcessPoolExecutor):
    def submit(self, *task: Any, **more: Any) -> Future[Any]:
        with deaf_children():
            return super().submit(*task, **more)


@contextmanager
def workers(count: int, begin: Callable[..., object], *arguments: Any) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes that share work, and end with the block, or with this process, however that ends.

    Args:
        count: How many.
        begin: What each one calls first.
        arguments: What it takes.
    """
    # Fresh: a forked one would inherit torch's threads in an unknown state.
    context = multiprocessing.get_context("spawn")
    with _Pool(count, context, _begin_worker, (os.getpid(), begin, arguments)) as pool:
        try:
            yield pool
        except BaseException:
            _end_children()  # the pool is broken by that, and waits for nothing
            raise


def _end_children() -> None:
    for child in multiprocessing.active_children():
        child.kill()


def _begin_worker(pid: int, begin: Callable[..., object], arguments: tuple[Any, ...]) -> None:
    end_with(pid)
    begin(*arguments)


@contextmanager
def process_group() -> Iterator[int]:
    """A process group whose members end with the block, or with this process, however that ends."""
    # The kernel closes the pipe when this process is gone, and the group's first member then ends the others.
    guard = subprocess.Popen(["sh", "-c", "read _; kill -KILL 0"], stdin=subprocess.PIPE, process_group=0)
    try:
        yield guard.pid
    finally:
        guard.communicate()
