"""Where the simulated arm lives: in its own process and real time, or in lockstep with a virtual clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np
import torch

from apcc_torch.hardware.clock import Clock, VirtualClock
from apcc_torch.hardware.simulated.arm import SimulatedArm
from apcc_torch.hardware.simulated.board import Board, Mode, board_type


class World(ABC):
    """One arm, opened by its actuator or its sensor, whichever comes first, and closed by the last of them."""

    def __init__(self, arm: SimulatedArm, clock: Clock) -> None:
        self.arm = arm
        self.clock = clock
        self.board = Board(np.zeros((), board_type(arm.n_tendons, arm.n_bodies)))
        self.users: set[str] = set()

    def open(self, user: str) -> None:
        """Begins the arm's time, if it has not begun."""
        if not self.users:
            self._begin()
        self.users.add(user)

    def close(self, user: str) -> None:
        """Ends it with the last user. Safe to call in any state."""
        was_open = bool(self.users)
        self.users.discard(user)
        if was_open and not self.users:
            self._finish()

    @property
    def is_open(self) -> bool:
        """Whether the arm's time runs."""
        return bool(self.users)

    def metrics(self) -> dict[str, float]:
        """How much time passed without the arm, because it could not be computed in time."""
        return {"simulated_arm_behind_s": float(self.board.memory["slip"])}

    @abstractmethod
    def _begin(self) -> None: ...

    @abstractmethod
    def _finish(self) -> None: ...

    @abstractmethod
    def locked(self) -> AbstractContextManager[Board]:
        """A context with the board, nobody else writing to it.

        Raises:
            HardwareError: The arm is gone.
        """


class LockstepWorld(World):
    """The arm follows a virtual clock: a run is the same every time, and as fast as it can be computed.

    Args:
        arm: The arm.
        clock: The run's.
    """

    def __init__(self, arm: SimulatedArm, clock: VirtualClock) -> None:
        super().__init__(arm, clock)
        self.virtual = clock

    def _begin(self) -> None:
        with torch.inference_mode():
            self.board = Board(np.zeros((), board_type(self.arm.n_tendons, self.arm.n_bodies)))
            self.arm.begin(self.clock.now(), self.board)
        self.virtual.followers.append(self._follow)
        self._follow(self.clock.now())

    def _follow(self, time: float) -> None:
        with torch.inference_mode():
            # A step ahead, as in real time: a reader finds a knot on either side.
            while self.arm.time < time + self.arm.settings.step:
                memory = self.board.memory
                self.arm.advance(self.board, memory["goal"].copy(), Mode(int(memory["mode"])))

    def _finish(self) -> None:
        self.virtual.followers.remove(self._follow)

    @contextmanager
    def locked(self) -> Iterator[Board]:
        """A context with the board."""
        yield self.board
