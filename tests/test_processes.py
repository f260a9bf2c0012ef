"""Processes that end together, and a program that is asked to end."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable
from concurrent.futures import Future

import pytest

from apcc_torch.processes import deaf_children, end_with, process_group, stoppable, workers


def killed(work: Callable[[], None]) -> None:
    """Calls `work` in a process that is then killed; returns once all that it began has ended.

    What it begins inherits the end of a pipe, which is closed when the last of them is gone.
    """
    told, tells = os.pipe()
    os.set_inheritable(tells, True)
    pid = os.fork()
    if pid == 0:
        try:
            os.close(told)
            work()
            os.write(tells, b".")
            signal.pause()
        finally:
            os._exit(1)
    os.close(tells)
    assert os.read(told, 1) == b"."
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    assert os.read(told, 1) == b""
    os.close(told)


def test_a_process_ends_with_another() -> None:
    def work() -> None:
        head = os.getpid()
        if os.fork() == 0:
            end_with(head)
            while True:
                signal.pause()

    killed(work)


def test_a_process_ends_with_one_that_has_ended_already() -> None:
    gone = os.fork()
    if gone == 0:
        os._exit(0)
    os.waitpid(gone, 0)
    late = os.fork()
    if late == 0:
        end_with(gone)
        signal.pause()
    assert os.waitstatus_to_exitcode(os.waitpid(late, 0)[1]) == 1


def test_a_group_ends_with_the_process_that_made_it() -> None:
    groups = []

    def work() -> None:
        groups.append(process_group())
        group = groups[0].__enter__()
        # As a compiler does: a program that has begun another one.
        subprocess.Popen(["sh", "-c", "sleep 600 & wait"], close_fds=False, process_group=group)

    killed(work)


def test_a_group_ends_with_its_block() -> None:
    with process_group() as group:
        sleeper = subprocess.Popen(["sleep", "600"], process_group=group)
    assert sleeper.wait() == -signal.SIGKILL


def test_workers_end_with_the_block_that_breaks_off() -> None:
    def breaks_off() -> None:
        with workers(1, int) as pool:
            assert pool.submit(os.getppid).result() == os.getpid()
            begun.append(pool.submit(signal.pause))
            raise KeyboardInterrupt

    begun: list[Future[None]] = []
    with pytest.raises(KeyboardInterrupt):
        breaks_off()
    assert begun[0].done()


def test_children_leave_ctrl_c_to_their_parent() -> None:
    with deaf_children():
        child = subprocess.Popen(["sleep", "600"])
    child.send_signal(signal.SIGINT)
    child.terminate()
    assert child.wait() == -signal.SIGTERM
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.parametrize(("number", "by", "code"), [(signal.SIGINT, "Ctrl-C", 130), (signal.SIGTERM, "SIGTERM", 143)])
def test_a_program_that_is_asked_to_end_does(number: signal.Signals, by: str, code: int) -> None:
    told: list[str] = []

    def tell(words: str) -> None:
        signal.raise_signal(number)  # a second one, as to the program and to its group
        told.append(words)

    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as ended, stoppable(tell):
        signal.raise_signal(number)
    assert ended.value.code == code and told == [by] and signal.getsignal(number) == before


def test_what_is_ignored_stays_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stoppable(pytest.fail):
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
