"""The simulated arm in a process of its own, in real time."""

from __future__ import annotations

import ctypes
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from multiprocessing.synchronize import Event, Lock
from typing import Self

import numpy as np
import torch

from apcc_torch.errors import CommunicationError
from apcc_torch.hardware.clock import MonotonicClock
from apcc_torch.hardware.simulated.arm import SimulatedArm
from apcc_torch.hardware.simulated.board import Board, Mode, board_type
from apcc_torch.hardware.simulated.world import LockstepSettings, SimulatedWorld
from apcc_torch.hardware.world import RealTimeSettings

START_TIMEOUT = 120.0
"""Longest that the process may take to begin, s: it imports torch and lets the arm settle."""
LOCK_TIMEOUT = 0.5
"""Longest wait for the board, s. It is held for microseconds, unless its holder was killed."""
LAG = 0.02
"""How far the arm may fall behind before time passes without it, s: its frames are fresh on a busy machine too."""


def _board(arm: SimulatedArm, memory: ctypes.Array[ctypes.c_byte]) -> Board:
    return Board(np.ctypeslib.as_array(memory).view(board_type(arm.n_tendons, arm.n_bodies, arm.n)).reshape(()))


def serve(arm: SimulatedArm, memory: ctypes.Array[ctypes.c_byte], lock: Lock, over: Event, ready: Connection) -> None:
    """The process: steps the arm in real time until it is over, or the process that asked for it has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the runner brings the arm to rest
    torch.set_num_threads(1)
    board = _board(arm, memory)
    parent = multiprocessing.parent_process()
    scratch = Board(board.memory.copy())
    with torch.inference_mode():
        arm.begin(time.monotonic, scratch)
        ready.send("ready")
        while not over.is_set() and (parent is None or parent.is_alive()):
            lead = arm.time - time.monotonic() - arm.step
            if lead > 0:
                time.sleep(lead)
                continue
            if lead < -LAG:
                arm.skip(-lead)
                board.memory["slip"] -= lead
            with lock:
                goal, mode = board.memory["goal"].copy(), Mode(int(board.memory["mode"]))
            arm.advance(scratch, goal, mode)
            with lock:
                # What the arm writes, and nothing of what the runner writes.
                for name in ("knots", "n_knots", "frames", "n_frames", "diverged"):
                    board.memory[name] = scratch.memory[name]


@dataclass(frozen=True, kw_only=True)
class ProcessSettings(LockstepSettings, RealTimeSettings):
    """How the simulated arm keeps up with real time."""


class ProcessWorld(SimulatedWorld):
    """The arm in real time, computed where it does not disturb the loop.

    It ends with this process, however that ends. If it dies, every use of it raises CommunicationError.

    Args:
        arm: The arm.
        clock: The run's, a monotonic one.
    """

    settings_type = ProcessSettings

    def __init__(self, arm: SimulatedArm, clock: MonotonicClock) -> None:
        super().__init__(arm, clock)
        self.process: multiprocessing.process.BaseProcess | None = None

    @classmethod
    def around(cls, settings: ProcessSettings, arm: Callable[[float], SimulatedArm]) -> Self:
        """The world of an arm, on the machine's own clock."""
        return cls(arm(settings.step), MonotonicClock(settings.spin))

    def _begin(self) -> None:
        # A fresh interpreter: a fork would carry torch's and the log's threads over in an unknown state.
        context = multiprocessing.get_context("spawn")
        memory = RawArray("b", board_type(self.arm.n_tendons, self.arm.n_bodies, self.arm.n).itemsize)
        self.lock, self.over = context.Lock(), context.Event()
        self.board = _board(self.arm, memory)
        here, there = context.Pipe(duplex=False)
        self.process = context.Process(
            target=serve, args=(self.arm, memory, self.lock, self.over, there), name="simulated arm", daemon=True
        )
        self.arm.steppers()  # here first: what has to be built then lies ready, and takes no time that has a limit
        self.process.start()
        there.close()
        try:
            begun = here.poll(START_TIMEOUT)
            if begun:
                here.recv()
        except EOFError as error:
            self._finish()
            raise CommunicationError("the simulated arm's process ended before it began") from error
        finally:
            here.close()
        if not begun:
            self._finish()
            raise CommunicationError(f"the simulated arm did not begin within {START_TIMEOUT:g} s")
        deadline = time.monotonic() + LOCK_TIMEOUT
        while not self.board.memory["n_knots"] and time.monotonic() < deadline:
            time.sleep(self.arm.step)

    def _finish(self) -> None:
        if self.process is None:
            return
        self.over.set()
        self.process.join(2.0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process = None

    @contextmanager
    def locked(self) -> Iterator[Board]:
        """A context with the board.

        Raises:
            CommunicationError: The process is gone, or holds the board for ever.
        """
        if self.process is None or not self.process.is_alive():
            raise CommunicationError("the simulated arm's process is not running")
        if not self.lock.acquire(timeout=LOCK_TIMEOUT):
            raise CommunicationError("the simulated arm does not let go of its memory")
        try:
            yield self.board
        finally:
            self.lock.release()
